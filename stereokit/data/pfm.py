"""Portable float maps: the disparity of SceneFlow, Middlebury and ETH3D."""

import math
import os
import re

import numpy as np
import numpy.typing as npt

from stereokit.data.disparity_arrays import (
    Disparity,
    PathLike,
    check_claimed_size,
    to_disparity,
    unknown_to_nan,
)
from stereokit.errors import InputError, printable
from stereokit.files import atomic_path, read_file_bytes

__all__ = ["pfm_bytes", "read_pfm", "write_pfm"]

_BLANK = rb"(?:[ \t\r\n]|#[^\n]*\n)+"
_HEADER = re.compile(
    rb"P(?P<kind>[fF])" + _BLANK + rb"(?P<width>\d{1,10})" + _BLANK + rb"(?P<height>\d{1,10})" + _BLANK
    + rb"(?P<scale>[-+0-9.eE]{1,32})[ \t\r]*(?:#[^\n]*)?\n"
)  # fmt: skip
_HEADER_LIMIT = 4096


def read_pfm(path: PathLike) -> Disparity:
    """Reads a disparity map from a portable float map.

    The header may hold blanks at the ends of lines, and comments. The sign of its scale gives the byte order;
    its magnitude is not applied, as in Middlebury's development kit, whose files carry display scales there.
    Rows are stored from the bottom up.

    Returns:
        (H, W) float32, NaN where the file holds NaN or an infinite value.

    Raises:
        InputError: a missing, malformed or truncated file, one with three channels, or too large a one.

    Source: http://www.pauldebevec.com/Research/HDR/PFM/ and https://vision.middlebury.edu/stereo/submit3/.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "disparity.pfm"
    >>> _ = path.write_bytes(b"Pf \\n2 1 \\n-1\\n" + np.array([3, np.inf], "<f4").tobytes())
    >>> read_pfm(path).tolist()
    [[3.0, nan]]
    """
    name = printable(path)
    match = _HEADER.match(read_file_bytes(path, _HEADER_LIMIT))
    if match is None:
        raise InputError(f"{name} is no PFM: expected a header 'Pf', width, height, scale, end of line")
    if match["kind"] == b"F":
        raise InputError(f"{name} is a PFM with three channels ('PF'); disparity has one ('Pf')")
    try:
        scale = float(match["scale"])
    except ValueError:
        scale = math.nan
    if not abs(scale) > 0:
        raise InputError(f"{name}: the PFM's scale is {match['scale'].decode()!r}; expected a number other than 0")
    height, width = int(match["height"]), int(match["width"])
    check_claimed_size(path, (height, width))
    expected, actual = match.end() + 4 * height * width, os.path.getsize(path)
    if actual != expected:
        raise InputError(
            f"{name} is {'truncated' if actual < expected else 'malformed'}: "
            f"a PFM of {width} x {height} pixels with this header has {expected} bytes, the file {actual}"
        )
    stored = np.frombuffer(read_file_bytes(path), "<f4" if scale < 0 else ">f4", offset=match.end())
    return unknown_to_nan(stored.reshape(height, width)[::-1])


def write_pfm(path: PathLike, disparity: npt.ArrayLike, *, overwrite: bool = False) -> None:
    """Writes a disparity map as a little-endian portable float map, unknown as +inf as Middlebury does.

    Raises:
        InputError: `disparity` is not (H, W), or the file can't be written.
    """
    values = to_disparity(path, disparity)
    stored = np.where(np.isnan(values), np.float32(np.inf), values)
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(pfm_bytes(stored))


def pfm_bytes(values: npt.NDArray[np.float32]) -> bytes:
    """The little-endian portable float map of values (H, W), as they are.

    >>> pfm_bytes(np.zeros((1, 2), np.float32))[:10]
    b'Pf\\n2 1\\n-1\\n'
    """
    height, width = values.shape
    return f"Pf\n{width} {height}\n-1\n".encode() + values[::-1].astype("<f4").tobytes()
