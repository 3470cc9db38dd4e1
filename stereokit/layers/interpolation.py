"""Maps at a finer resolution by interpolation."""

from torch import Tensor
from torch.nn import functional as F

__all__ = ["bilinear_upsample"]


def bilinear_upsample(disparity: Tensor, scale: int, *, align_corners: bool = False) -> Tensor:
    """Disparity (B, h, w) to (B, h * scale, w * scale); values are not scaled.

    Args:
        disparity: (B, h, w).
        scale: a whole number.
        align_corners: the middles of the corner pixels lie upon each other, as some published networks have it, in
            place of the corners themselves.

    >>> import torch
    >>> bilinear_upsample(torch.full((1, 2, 3), 7.0), 4).unique()
    tensor([7.])
    """
    if scale == 1:
        return disparity
    return F.interpolate(
        disparity.unsqueeze(1), scale_factor=scale, mode="bilinear", align_corners=align_corners
    ).squeeze(1)
