"""The left-right check: what only one of the two cameras sees."""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from stereokit.errors import InputError

__all__ = ["Match", "occluded", "right_disparity"]

Match: TypeAlias = Callable[[npt.NDArray[Any], npt.NDArray[Any]], npt.NDArray[Any]]
"""Left and right images, (H, W, 3) each, to the left view's disparity (H, W)."""


def right_disparity(match: Match, left: npt.NDArray[Any], right: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The right view's disparity, from what matches left views: that of the pair in a mirror, mirrored back.

    Args:
        match: left and right images to the left view's disparity.
        left: (H, W, 3) or (H, W).
        right: of the same shape.

    Returns:
        (H, W); the match of the right pixel in column x lies in column x + d of the left view.

    Raises:
        InputError: images of different shapes.

    >>> def constant(left, right):
    ...     return np.full(left.shape[:2], 3.0)
    >>> right_disparity(constant, np.zeros((1, 2, 3)), np.zeros((1, 2, 3))).tolist()
    [[3.0, 3.0]]
    """
    if left.shape != right.shape:
        raise InputError(f"the left image has shape {left.shape}, the right one {right.shape}; expected one shape")
    mirrored = match(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]))
    return np.ascontiguousarray(mirrored[:, ::-1])


def occluded(
    left_disparity: npt.NDArray[Any], right_disparity: npt.NDArray[Any], *, tau: float = 2.0
) -> npt.NDArray[np.bool_]:
    """Which left pixels the right camera does not see: |d_left(x) - d_right(x - d_left(x))| > tau.

    Args:
        left_disparity: (H, W) in pixels, NaN where unknown.
        right_disparity: the right view's own, (H, W).
        tau: the largest difference of what is one point, in pixels.

    Returns:
        (H, W), True where the match lies outside of the right view, where either disparity is unknown, and where the
        two disagree. The right map is read at the nearest column.

    Raises:
        InputError: maps of different shapes, or a negative `tau`.

    >>> left = np.array([[1.0, 1.0, 1.0, 3.0]])
    >>> right = np.array([[1.0, 1.0, 1.0, 1.0]])
    >>> occluded(left, right, tau=1.0).tolist()
    [[True, False, False, True]]
    """
    if left_disparity.ndim != 2 or left_disparity.shape != right_disparity.shape:
        raise InputError(
            f"the disparity maps have shapes {left_disparity.shape} and {right_disparity.shape}; expected one (H, W)"
        )
    if not tau >= 0:
        raise InputError(f"tau must be at least 0 px, got {tau}")
    width = left_disparity.shape[1]
    match = np.rint(np.arange(width) - np.where(np.isfinite(left_disparity), left_disparity, 2.0 * width))
    seen = (match >= 0) & (match < width)
    there = np.take_along_axis(right_disparity, np.where(seen, match, 0).astype(np.intp), axis=1)
    with np.errstate(invalid="ignore"):
        agrees = np.abs(left_disparity - there) <= tau
    return ~(seen & agrees)
