"""Two views in one picture."""

from typing import Literal, TypeAlias, get_args

import numpy as np

from stereokit.errors import ConfigError, InputError
from stereokit.video.frames import Image

__all__ = ["Layout", "check_layout", "split"]

Layout: TypeAlias = Literal["side-by-side", "top-bottom"]
"""The left view is the left half, or the upper one."""


def check_layout(layout: str) -> None:
    """Raises `ConfigError` for an unknown layout."""
    if layout not in get_args(Layout):
        raise ConfigError(f"unknown layout {layout!r}; expected {' or '.join(map(repr, get_args(Layout)))}")


def split(image: Image, layout: Layout, name: str = "the image") -> tuple[Image, Image]:
    """The left and the right view of a picture that holds both.

    Args:
        image: (H, W, 3).
        layout: "side-by-side" (left half, right half) or "top-bottom" (upper half is the left view).
        name: what messages call it.

    Raises:
        InputError: the side that is halved is odd.
        ConfigError: an unknown layout.

    >>> left, right = split(np.arange(12, dtype=np.uint8).reshape(1, 4, 3), "side-by-side")
    >>> left.shape, int(right[0, 0, 0])
    ((1, 2, 3), 6)
    """
    check_layout(layout)
    axis = 1 if layout == "side-by-side" else 0
    if image.shape[axis] % 2:
        height, width = image.shape[:2]
        raise InputError(
            f"{name} has {width} x {height} pixels, which can't be halved as {layout!r}; expected an even "
            f"{'width' if axis else 'height'}"
        )
    left, right = np.split(image, 2, axis)
    return np.ascontiguousarray(left), np.ascontiguousarray(right)
