"""Disparity maps from and to files of any known encoding.

All readers give float32 (H, W), in pixels of the left image, with NaN where the disparity is unknown. Two
things can't be seen in a file: by how much an 8-bit PNG was scaled, and whether a colour PNG is an encoded
disparity or a picture. The caller says those.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stereokit.data.disparity_arrays import Disparity, PathLike, unknown_to_nan
from stereokit.data.disparity_png import (
    KITTI_SCALE,
    is_grey,
    read_drivingstereo_full_png,
    read_kitti_png,
    read_scaled_png,
    read_sintel_png,
    unscaled,
    write_kitti_png,
)
from stereokit.data.images import read_image_depth, read_samples
from stereokit.data.npy import NPY_MAGIC, read_npy, read_npz, write_npy, write_npz
from stereokit.data.pfm import read_pfm, write_pfm
from stereokit.errors import InputError, printable
from stereokit.files import read_file_bytes

__all__ = ["ENCODINGS", "assumed_scale", "read_disparity", "write_disparity"]

ENCODINGS: dict[str, Callable[[PathLike], Disparity]] = {
    "pfm": read_pfm,
    "npy": read_npy,
    "npz": read_npz,
    "kitti": read_kitti_png,
    "drivingstereo": read_kitti_png,
    "drivingstereo-full": read_drivingstereo_full_png,
    "sintel": read_sintel_png,
}
"""The encodings that `read_disparity` takes by name, each with its reader."""

_MAGICS = {b"Pf": read_pfm, b"PF": read_pfm, NPY_MAGIC: read_npy, b"PK\3\4": read_npz}


def read_disparity(path: PathLike, *, scale: float | None = None, encoding: str | None = None) -> Disparity:
    """Reads a disparity map of any known encoding, which it finds by looking at the file.

    ===========================  =================================================================
    the file                     is read as
    ===========================  =================================================================
    PFM                          disparity; infinite and NaN are unknown
    npy, npz                     disparity; infinite and NaN are unknown
    16-bit grey PNG              KITTI's encoding, value / 256; 0 is unknown
    8-bit grey PNG or PGM        value / `scale`; 0 is unknown. `scale` must be given
    floating-point TIFF          disparity; infinite and NaN are unknown
    colour PNG                   Sintel's encoding if `encoding` says so, else an error
    ===========================  =================================================================

    Args:
        path: the file.
        scale: the stored value of one pixel of disparity, for grey images; of 16 bits too, where it is not
            256.
        encoding: one of `ENCODINGS`, to say what the bytes can't, or to insist: "pfm", "npy", "npz", "kitti",
            "drivingstereo" (half size, as KITTI's), "drivingstereo-full" (full size, value / 128), "sintel".

    Returns:
        (H, W) float32, NaN where unknown.

    Raises:
        InputError: the file is missing, broken, too large, of another kind, or does not say enough by itself.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "disparity.png"
    >>> write_disparity(path, np.array([[1.5, np.nan]], np.float32))
    >>> read_disparity(path).tolist()
    [[1.5, nan]]
    """
    name = printable(path)
    if encoding is not None:
        if scale is not None:
            raise InputError(f"{name}: give scale or encoding, not both; got {scale} and {encoding!r}")
        if encoding not in ENCODINGS:
            raise InputError(f"unknown disparity encoding {encoding!r}; expected one of {', '.join(ENCODINGS)}")
        return ENCODINGS[encoding](path)
    start = read_file_bytes(path, 8)
    for magic, reader in _MAGICS.items():
        if start.startswith(magic):
            if scale is not None:
                raise InputError(f"{name} holds disparity itself, which has no scale; leave out scale={scale}")
            return reader(path)
    if scale is not None:
        return read_scaled_png(path, scale=scale)
    samples = read_samples(path, floating=True)
    if samples.dtype.kind == "f" and samples.ndim == 2:
        return unknown_to_nan(samples)
    if samples.dtype == np.uint16 and samples.ndim == 2:
        return unscaled(samples, KITTI_SCALE)
    if is_grey(samples):
        raise InputError(
            f"{name} is a grey image of {samples.dtype}, which does not say how disparity was scaled; give "
            "scale=, the stored value of one pixel of disparity (such as 4 for Middlebury 2003)"
        )
    raise InputError(
        f"{name} is a colour image, not known to be disparity; say encoding='sintel' if it is encoded as "
        "Sintel's, or give a grey PNG, a PFM or an npy file"
    )


def assumed_scale(path: PathLike) -> float | None:
    """The scale that `read_disparity` takes for granted where it is told none: KITTI's 256 of grey 16-bit images.

    Returns:
        None for files that hold disparity itself, and for those that can't be read.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> write_disparity(folder / "a.png", [[1.5]])
    >>> write_disparity(folder / "a.pfm", [[1.5]])
    >>> assumed_scale(folder / "a.png"), assumed_scale(folder / "a.pfm")
    (256.0, None)
    """
    try:
        if read_file_bytes(path, 8).startswith(tuple(_MAGICS)):
            return None
        depth = read_image_depth(path)
    except InputError:
        return None
    return float(KITTI_SCALE) if depth == 16 else None


def write_disparity(path: PathLike, disparity: npt.ArrayLike, *, overwrite: bool = False) -> None:
    """Writes a disparity map, in the format that the suffix names.

    Args:
        path: ends in .pfm, .npy, .npz (exact, float32) or .png (KITTI's encoding, steps of 1/256 up to
            255.996).
        disparity: (H, W) in pixels, floating-point or whole numbers. NaN and infinite are unknown.
        overwrite: replace an existing file.

    Raises:
        InputError: another suffix or shape, a value that the format can't hold, or a file that can't be
            written.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "disparity.pfm"
    >>> write_disparity(path, [[1.5, 2.25]])
    >>> read_disparity(path).tolist()
    [[1.5, 2.25]]
    """
    writers = {".pfm": write_pfm, ".png": write_kitti_png, ".npy": write_npy, ".npz": write_npz}
    suffix = Path(path).suffix.lower()
    if suffix not in writers:
        raise InputError(f"{printable(path)}: disparity is written as {', '.join(writers)}, not {suffix!r}")
    writers[suffix](path, disparity, overwrite=overwrite)
