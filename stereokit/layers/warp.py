"""Maps of the right view, seen from the left one by candidate disparities."""

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

__all__ = ["warp"]


def warp(right: Tensor, disparity: Tensor, *, outside: Literal["zeros", "border"] = "zeros") -> Tensor:
    r"""The right map where each pixel of the left one would find its partner.

    .. math:: w(d, y, x) = r(y, x - c_d(y, x))

    Between two pixels it is interpolated linearly.

    Args:
        right: r, (B, C, H, W).
        disparity: c, (B, D, H, W), in pixels of the map.
        outside: what lies outside the map: "zeros", or the nearest pixel of its "border".

    Returns:
        (B, C, D, H, W).

    >>> right = torch.tensor([[[[1.0, 2.0, 3.0]]]])
    >>> warp(right, torch.full((1, 1, 1, 3), 0.5)).flatten()
    tensor([0.5000, 1.5000, 2.5000])
    """
    batch, planes, height, width = disparity.shape
    x = torch.arange(width, device=right.device, dtype=disparity.dtype) - disparity
    y = torch.arange(height, device=right.device, dtype=disparity.dtype).reshape(-1, 1).expand(batch, planes, -1, width)
    # pixel centres from -1 to 1; of a single row or column any number is its centre
    grid = torch.stack((2 * x / max(width - 1, 1) - 1, 2 * y / max(height - 1, 1) - 1), dim=-1)
    sampled = F.grid_sample(
        right, grid.flatten(1, 2).to(right.dtype), mode="bilinear", padding_mode=outside, align_corners=True
    )
    return sampled.reshape(batch, -1, planes, height, width)
