"""What the disparity formats share: the type, its one mark for unknown, and the checks of shape and size."""

import math
import os
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from stereokit.data.images import MAX_BYTES, MAX_PIXELS
from stereokit.errors import InputError, printable

__all__ = [
    "Disparity",
    "PathLike",
    "check_claimed_size",
    "doubts",
    "doubts_of_prediction",
    "to_disparity",
    "unknown_to_nan",
]

PathLike: TypeAlias = "str | os.PathLike[str]"

Disparity: TypeAlias = npt.NDArray[np.float32]
"""(H, W) in pixels of the left image, NaN where unknown."""


def to_disparity(path: PathLike, values: npt.ArrayLike) -> Disparity:
    """The values as disparity, ready to be written to `path`.

    Raises:
        InputError: they are not real numbers of shape (H, W), or are whole numbers below 0, which no unit explains but
            that of OpenCV's matchers.
    """
    array = np.asarray(values)
    if array.ndim != 2 or array.size == 0 or array.dtype.kind not in "fiu":
        raise InputError(
            f"{printable(path)}: expected disparity as real numbers of shape (H, W), "
            f"got {array.dtype} of shape {array.shape}"
        )
    if array.dtype.kind == "i" and array.min() < 0:
        raise InputError(
            f"{printable(path)}: {doubts(array) or 'whole numbers below 0'}; expected disparity in pixels, NaN where "
            "unknown"
        )
    return unknown_to_nan(array)


def unknown_to_nan(stored: npt.NDArray[Any]) -> Disparity:
    """A float32 copy in which every value that is not finite is NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        values: Disparity = np.array(stored, np.float32, order="C")
    values[~np.isfinite(values)] = np.nan
    return values


def check_claimed_size(path: PathLike, shape: tuple[int, ...], sample_bytes: int = 4) -> None:
    """Refuses a header's size before memory is reserved for it.

    Raises:
        InputError: no pixels, more than `MAX_PIXELS`, or more than `MAX_BYTES` of samples of so many bytes and their
            float32 copy.
    """
    pixels = math.prod(shape)
    claimed = f"{printable(path)} claims {' x '.join(str(side)[:12] for side in reversed(shape))} pixels"
    if not (min(shape) > 0 and pixels <= MAX_PIXELS):
        raise InputError(f"{claimed}; expected at least 1 and at most {MAX_PIXELS} in all")
    if pixels * (sample_bytes + 4) > MAX_BYTES:
        raise InputError(
            f"{claimed} of {sample_bytes} bytes; expected at most {MAX_BYTES // 2**20} MiB in all: save it as float32"
        )


def doubts_of_prediction(disparity: npt.NDArray[Any]) -> str | None:
    """What is odd about disparity that a matcher gave, or None; see `doubts`, which this asks first.

    >>> doubts_of_prediction(np.array([[3, 4]], np.uint8))
    'whole numbers (uint8): if they stand for another unit than pixels, or were cut off, give floating-point pixels'
    """
    odd = doubts(disparity)
    if odd is None and disparity.dtype.kind in "iu":
        return (
            f"whole numbers ({disparity.dtype}): if they stand for another unit than pixels, or were cut off, give "
            "floating-point pixels"
        )
    return odd


def doubts(disparity: npt.NDArray[Any]) -> str | None:
    """What is odd about disparity in pixels, or None: another unit or sign than pixels of the left image, most likely.

    Args:
        disparity: of any shape and real type, NaN where unknown.

    Returns:
        A sentence that says what was seen and what to do.

    >>> doubts(np.array([[160, 240, -16]], np.int16))
    'whole numbers of which the smallest is -16, as cv2.StereoSGBM gives 16 times the disparity: divide by 16.0, ...'
    >>> doubts(np.array([[1.5, 2.25, np.nan]]))
    """
    known = disparity[np.isfinite(disparity)] if disparity.dtype.kind == "f" else disparity.ravel()
    if known.size == 0:
        return None
    low, high = float(known.min()), float(known.max())
    if high < 0:
        return f"all disparities are negative, {low:g} to {high:g}: if they count leftward, negate them"
    if disparity.dtype.kind == "i" and low < 0 and low % 16 == 0:
        return (
            f"whole numbers of which the smallest is {low:g}, as cv2.StereoSGBM gives 16 times the disparity: "
            "divide by 16.0, and make what was negative NaN"
        )
    if high > 16 and known.size > 1 and low < high and not np.mod(known, 16).any():
        return "all disparities are multiples of 16: if they are 16 times the pixels, as OpenCV's are, divide by 16.0"
    return None
