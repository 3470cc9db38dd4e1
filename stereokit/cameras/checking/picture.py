"""A picture of where the views match."""

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.checking.check import PairCheck
from stereokit.data.images import to_uint8
from stereokit.errors import InputError

__all__ = ["matches_picture"]

_MOST_LINES = 150
_ROWS = 12  # horizontal lines
_GREY = (128, 128, 128)
_COLOURS = ((0.5, (40, 200, 40)), (1.0, (180, 220, 0)), (2.0, (255, 160, 0)), (np.inf, (255, 40, 40)))
"""Of a match, RGB, by how many rows its points are apart at most."""


def matches_picture(check: PairCheck, left: npt.NDArray[Any], right: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """Both views beside each other, with horizontal lines, and lines between matches.

    Matches are green up to half a row apart, yellow up to one, orange up to two, red beyond.

    Args:
        check: of the pair.
        left: (H, W, 3), uint8 or floating-point in [0, 1].
        right: of the same size.

    Returns:
        RGB, (H, 2 W, 3).

    Raises:
        InputError: images of different sizes, or not (H, W, 3).
    """
    if left.shape != right.shape or left.ndim != 3 or left.shape[2] != 3:
        raise InputError(f"expected two images of one shape (H, W, 3), got {left.shape} and {right.shape}")
    height, width = left.shape[:2]
    picture = np.ascontiguousarray(np.concatenate([to_uint8(left), to_uint8(right)], axis=1))
    for row in np.linspace(0, height - 1, _ROWS + 2).astype(int)[1:-1].tolist():
        cv2.line(picture, (0, row), (2 * width - 1, row), _GREY, 1)
    matches = check.matches
    if matches is not None and len(matches):
        # evenly over the rows, so that no part of the picture is left out
        order = np.argsort(matches.left[:, 1], kind="stable")
        for i in order[np.linspace(0, len(order) - 1, min(len(order), _MOST_LINES)).astype(int)].tolist():
            apart = abs(float(matches.dy[i]))
            colour = next(colour for most, colour in _COLOURS if apart <= most)
            ends = [tuple(np.rint(point).astype(int).tolist()) for point in (matches.left[i], matches.right[i])]
            first, second = ends[0], (ends[1][0] + width, ends[1][1])
            cv2.line(picture, first, second, colour, 1, cv2.LINE_AA)
            cv2.circle(picture, first, 2, colour, -1)
            cv2.circle(picture, second, 2, colour, -1)
    return picture
