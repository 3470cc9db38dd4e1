"""Pairs whose disparities do not begin at 0."""

from numbers import Integral
from typing import Any

import torch
from torch import Tensor

from stereokit.errors import ConfigError, InputError

__all__ = ["checked_min_disparity", "shift_right"]


def checked_min_disparity(min_disparity: Any) -> int:
    """A whole number of pixels, which is what images can be shifted by exactly.

    Raises:
        ConfigError: anything else.
    """
    if isinstance(min_disparity, bool) or not isinstance(min_disparity, Integral):
        raise ConfigError(f"min_disparity is {min_disparity!r}; expected a whole number of pixels, such as -32")
    return int(min_disparity)


def shift_right(right: Tensor, min_disparity: int) -> Tensor:
    """The right view as if all disparities were smaller by `min_disparity`: what lay in column x lies in x + it.

    A network that finds disparities from 0 up finds those from `min_disparity` up in the shifted pair, each smaller by
    as much. Columns that nothing moves into repeat the one beside them.

    Args:
        right: (B, 3, H, W).
        min_disparity: in pixels, above or below 0.

    Raises:
        InputError: nothing of the view would be left.

    >>> shift_right(torch.tensor([[[[1, 2, 3, 4]]]]), -1).tolist()
    [[[[2, 3, 4, 4]]]]
    """
    width = right.shape[-1]
    if abs(min_disparity) >= width:
        raise InputError(
            f"min_disparity is {min_disparity} px, and the images are {width} px wide: nothing of the right view is "
            "left when it is moved so far; use one closer to 0"
        )
    if min_disparity == 0:
        return right
    columns = torch.arange(width, device=right.device) - min_disparity
    return right.index_select(-1, columns.clamp(0, width - 1))
