"""Metric depth out of disparity, its uncertainty, and its files."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.calibration.rectified import Calibration, PathLike
from stereokit.data.disparity_arrays import unknown_to_nan
from stereokit.data.images import write_samples
from stereokit.data.npy import save_arrays
from stereokit.data.pfm import pfm_bytes
from stereokit.errors import InputError
from stereokit.files import atomic_path

__all__ = ["DEPTH_SUFFIXES", "Depth", "depth_from_disparity", "depth_standard_error", "fill_background", "write_depth"]

Depth: TypeAlias = npt.NDArray[np.float32]
"""(H, W) in metres along the optical axis, NaN where unknown."""

_MILLIMETRES = 1000
_MOST_MILLIMETRES = 65535


def depth_from_disparity(
    disparity: npt.ArrayLike,
    calibration: Calibration,
    *,
    valid: npt.NDArray[np.bool_] | None = None,
    max_depth: float | None = None,
) -> Depth:
    """Depth along the optical axis, Z = baseline fx / (d + cx1 - cx0).

    Args:
        disparity: (H, W) in pixels, NaN where unknown.
        calibration: of images of this size.
        valid: (H, W), False where the disparity is not to be believed.
        max_depth: in metres; what is farther becomes unknown.

    Returns:
        (H, W) float32 in metres, NaN where unknown: where the disparity is, and where d + cx1 - cx0 is not positive.

    Raises:
        InputError: a disparity that is not (H, W), a calibration or a mask of another size, or a `max_depth` that is
            not positive.

    >>> camera = Calibration(fx=700.0, baseline=0.5, cx0=1.0, cx1=1.0)
    >>> depth_from_disparity([[10.0, 0.0, 1.0]], camera, max_depth=100.0).tolist()
    [[35.0, nan, nan]]
    """
    values = _checked(disparity, calibration, valid)
    depth = calibration.depth(values)
    if valid is not None:
        depth[~valid] = np.nan
    if max_depth is not None:
        if not max_depth > 0:
            raise InputError(f"max_depth must be a positive number of metres, got {max_depth}")
        depth[depth > max_depth] = np.nan
    return depth


def depth_standard_error(
    disparity: npt.ArrayLike, calibration: Calibration, disparity_error: float | npt.NDArray[Any]
) -> Depth:
    """The standard error of depth from that of disparity, to first order: s_Z = Z^2 / (baseline fx) s_d.

    Args:
        disparity: (H, W) in pixels, NaN where unknown.
        calibration: of images of this size.
        disparity_error: its standard error in pixels, one for all or (H, W).

    Returns:
        (H, W) float32 in metres, NaN where depth or error is unknown.

    Raises:
        InputError: as `depth_from_disparity`; or an error below 0 or of another shape.

    >>> camera = Calibration(fx=700.0, baseline=0.5, cx0=1.0, cx1=1.0)
    >>> depth_standard_error([[17.5]], camera, 0.4375).tolist()
    [[0.5]]
    """
    values = _checked(disparity, calibration, None)
    error = np.asarray(disparity_error, np.float64)
    if error.ndim and error.shape != values.shape:
        raise InputError(f"disparity_error has shape {error.shape}; expected one number, or {values.shape}")
    if (error < 0).any():
        raise InputError(f"disparity_error must be at least 0, got {np.nanmin(error):g}")
    depth = calibration.depth(values).astype(np.float64)
    with np.errstate(over="ignore"):
        result = (depth**2 / (calibration.baseline * calibration.fx) * error).astype(np.float32)
    result[~np.isfinite(result)] = np.nan
    return result


def fill_background(disparity: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Fills what is unknown with the background beside it: the smaller one of the nearest known disparities in the row.

    What one camera does not see lies on the farther surface. Rows without any known pixel stay unknown.

    Args:
        disparity: (H, W), NaN where unknown.

    >>> nan = float("nan")
    >>> fill_background([[nan, 5.0, nan, nan, 2.0, nan], [nan] * 6]).tolist()
    [[5.0, 5.0, 2.0, 2.0, 2.0, 2.0], [nan, nan, nan, nan, nan, nan]]
    """
    values = np.asarray(disparity, np.float32)
    known = np.isfinite(values)
    columns = np.arange(values.shape[1])
    before = np.maximum.accumulate(np.where(known, columns, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, columns, values.shape[1])[:, ::-1], axis=1)[:, ::-1]
    padded = np.pad(values, ((0, 0), (1, 1)), constant_values=np.nan)
    beside = [np.take_along_axis(padded, side + 1, axis=1) for side in (before, after)]
    # fmin passes over NaN
    return np.where(known, values, np.fmin(*beside)).astype(np.float32)


def write_depth(path: PathLike, depth: npt.ArrayLike, *, overwrite: bool = False) -> int:
    """Writes depth, in the format that the suffix names.

    ===============  ==============================================================================
    suffix           the file
    ===============  ==============================================================================
    .png             16-bit grey, millimetres, 0 where unknown or farther than 65.535 m
    .npy             float32, metres, NaN where unknown
    .npz             the same, compressed, as "depth"
    .pfm             float32, metres, NaN where unknown, rows from the bottom up
    .tif, .tiff      float32, metres, NaN where unknown
    ===============  ==============================================================================

    Args:
        path: the file.
        depth: (H, W) in metres along the optical axis, NaN where unknown.
        overwrite: replace an existing file.

    Returns:
        How many known pixels the file does not hold, because they are farther than 65.535 m; 0 for all but .png.

    Raises:
        InputError: another suffix or shape, a depth that is not positive, or a file that can't be written.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "depth.png"
    >>> write_depth(path, [[1.25, 80.0, float("nan")]])
    1
    >>> cv2.imread(str(path), cv2.IMREAD_UNCHANGED).tolist()
    [[1250, 0, 0]]
    """
    name = os.fspath(path)
    suffix = Path(path).suffix.lower()
    if suffix not in DEPTH_SUFFIXES:
        raise InputError(f"{name!r}: depth is written as {', '.join(DEPTH_SUFFIXES)}, not {suffix!r}")
    values = np.asarray(depth)
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "fiu":
        raise InputError(
            f"{name!r}: expected depth as real numbers of shape (H, W), got {values.dtype} of shape {values.shape}"
        )
    metres: Depth = unknown_to_nan(values)
    if (metres <= 0).any():
        raise InputError(f"{name!r}: depth is positive, and NaN where unknown; got {np.nanmin(metres):g}")
    if suffix == ".png":
        return _write_png(path, metres, overwrite=overwrite)
    with atomic_path(path, overwrite=overwrite) as temporary:
        _WRITERS[suffix](temporary, metres)
    return 0


def _write_png(path: PathLike, metres: Depth, *, overwrite: bool) -> int:
    millimetres = np.rint(metres.astype(np.float64) * _MILLIMETRES)
    beyond = millimetres > _MOST_MILLIMETRES
    held = np.isfinite(millimetres) & ~beyond
    samples = np.zeros(metres.shape, np.uint16)
    # 0 stands for unknown
    samples[held] = np.maximum(millimetres[held], 1)
    write_samples(path, samples, overwrite=overwrite)
    return int(beyond.sum())


def _write_npy(path: Path, metres: Depth) -> None:
    np.save(path, metres, allow_pickle=False)


def _write_npz(path: Path, metres: Depth) -> None:
    save_arrays(path, depth=metres)


def _write_pfm(path: Path, metres: Depth) -> None:
    path.write_bytes(pfm_bytes(metres))


def _write_tiff(path: Path, metres: Depth) -> None:
    _, encoded = cv2.imencode(".tiff", metres)
    path.write_bytes(encoded.tobytes())


_WRITERS: dict[str, Callable[[Path, Depth], None]] = {
    ".npy": _write_npy,
    ".npz": _write_npz,
    ".pfm": _write_pfm,
    ".tif": _write_tiff,
    ".tiff": _write_tiff,
}

DEPTH_SUFFIXES = (".png", *_WRITERS)
"""Of the files that `write_depth` makes."""


def _checked(
    disparity: npt.ArrayLike, calibration: Calibration, valid: npt.NDArray[np.bool_] | None
) -> npt.NDArray[Any]:
    values = np.asarray(disparity)
    if values.ndim != 2 or values.size == 0 or values.dtype.kind not in "fiu":
        raise InputError(f"expected disparity as real numbers (H, W), got {values.dtype} of shape {values.shape}")
    calibration.check_size(*values.shape)
    if valid is not None and (valid.shape != values.shape or valid.dtype != np.bool_):
        raise InputError(f"valid is {valid.dtype} of shape {valid.shape}; expected bool of shape {values.shape}")
    return values
