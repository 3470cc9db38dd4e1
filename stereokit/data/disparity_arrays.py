"""What the disparity formats share: the type, its one mark for unknown, and the checks of shape and size."""

import math
import os
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from stereokit.data.images import MAX_PIXELS
from stereokit.errors import InputError

__all__ = ["Disparity", "PathLike", "check_claimed_size", "to_disparity", "unknown_to_nan"]

PathLike: TypeAlias = "str | os.PathLike[str]"

Disparity: TypeAlias = npt.NDArray[np.float32]
"""(H, W) in pixels of the left image, NaN where unknown."""


def to_disparity(path: PathLike, values: npt.ArrayLike) -> Disparity:
    """The values as disparity, ready to be written to `path`.

    Raises:
        InputError: they are not real numbers of shape (H, W).
    """
    array = np.asarray(values)
    if array.ndim != 2 or array.size == 0 or array.dtype.kind not in "fiu":
        raise InputError(
            f"{os.fspath(path)!r}: expected disparity as real numbers of shape (H, W), "
            f"got {array.dtype} of shape {array.shape}"
        )
    return unknown_to_nan(array)


def unknown_to_nan(stored: npt.NDArray[Any]) -> Disparity:
    """A float32 copy in which every value that is not finite is NaN."""
    with np.errstate(over="ignore", invalid="ignore"):
        values: Disparity = np.array(stored, np.float32, order="C")
    values[~np.isfinite(values)] = np.nan
    return values


def check_claimed_size(path: PathLike, shape: tuple[int, ...]) -> None:
    """Refuses a header's size before memory is reserved for it.

    Raises:
        InputError: no pixels, or more than `MAX_PIXELS`.
    """
    if not (min(shape) > 0 and math.prod(shape) <= MAX_PIXELS):
        claimed = " x ".join(str(side) for side in reversed(shape))
        raise InputError(
            f"{os.fspath(path)!r} claims {claimed} pixels; expected at least 1 and at most {MAX_PIXELS} in all"
        )
