"""Correlation around a disparity that is known from a coarser scale."""

import torch
from torch import Tensor

from stereokit.costs.shift import check_features
from stereokit.costs.signed_correlation import SignedCorrelation, signed_correlation
from stereokit.errors import InputError
from stereokit.layers import warp

__all__ = ["WarpedCorrelation", "warped_correlation"]

SLACK = 1e-4
"""px beyond the border that rounding may lead to."""


def warped_correlation(left: Tensor, right: Tensor, disparity: Tensor, radius: int) -> Tensor:
    r"""`signed_correlation` with the right map, once it is brought to where a disparity says that it belongs.

    .. math:: C(k, y, x) = \frac{1}{|c|} \sum_c l_c(y, x)\, w_c(y, x + k - R), \quad
        w(y, x) = r(y, x - d(y, x)), \quad k = 0 \ldots 2 R

    w is interpolated linearly, and 0 where x - d lies outside the map. What is left of the disparity, e, is at channel
    R - e: of each neighbour it is the neighbour's own d that counts.

    Args:
        left: l, (B, C, H, W).
        right: r, (B, C, H, W).
        disparity: d, (B, H, W), in pixels of the maps.
        radius: R, in pixels of the maps, 0 or more.

    Returns:
        (B, 2 R + 1, H, W).

    Raises:
        InputError: the maps are not a pair, the disparity is of another size, or a negative radius.

    Source: Yin et al., "Hierarchical discrete distribution decomposition for match density estimation", CVPR 2019,
    section 3.3; Sun et al., "PWC-Net", CVPR 2018.

    >>> left, right = torch.ones(1, 2, 1, 3), torch.tensor([1.0, 2.0, 3.0]).expand(1, 2, 1, 3)
    >>> warped_correlation(left, right, torch.ones(1, 1, 3), 1)[0, :, 0]
    tensor([[0., 0., 1.],
            [0., 1., 2.],
            [1., 2., 0.]])
    """
    check_features(left, right, 1)
    if disparity.shape != left[:, 0].shape:
        raise InputError(
            f"the disparity is (B, H, W), of the size of the maps; got {tuple(disparity.shape)} for {tuple(left.shape)}"
        )
    width = right.shape[-1]
    column = torch.arange(width, device=right.device, dtype=disparity.dtype) - disparity
    inside = (column >= -SLACK) & (column <= width - 1 + SLACK)
    warped = warp(right, disparity.unsqueeze(1)).squeeze(2) * inside.unsqueeze(1).to(right.dtype)
    return signed_correlation(left, warped, radius)


class WarpedCorrelation(SignedCorrelation):
    """`warped_correlation` as a module.

    Args:
        radius: in pixels of the maps.

    Shape: two (B, C, H, W) and a disparity (B, H, W), or None for 0, to (B, 2 * radius + 1, H, W).

    Raises:
        ConfigError: a negative radius.

    >>> WarpedCorrelation(radius=4)(*torch.rand(2, 1, 8, 4, 16), torch.rand(1, 4, 16)).shape
    torch.Size([1, 9, 4, 16])
    """

    def forward(self, left: Tensor, right: Tensor, disparity: Tensor | None = None) -> Tensor:
        """Left and right features, and a disparity, to a map."""
        if disparity is None:
            return super().forward(left, right)
        return warped_correlation(left, right, disparity, self.radius)
