"""Correlation over shifts to both sides, as channels of a map rather than as a volume."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.costs.shift import check_features, inner_products
from stereokit.errors import ConfigError, InputError

__all__ = ["SignedCorrelation", "signed_correlation"]

FEW = 4
"""The largest radius that is computed shift by shift."""


def signed_correlation(left: Tensor, right: Tensor, radius: int) -> Tensor:
    r"""Mean product of left features and right ones up to `radius` pixels to both sides.

    .. math:: C(k, y, x) = \frac{1}{|c|} \sum_c l_c(y, x)\, r_c(y, x + k - R), \quad k = 0 \ldots 2 R

    0 where the right map has no such pixel. Disparity d is at channel R - d; those above R look the wrong way, where a
    pair that is not well rectified may match.

    Args:
        left: l, (B, C, H, W).
        right: r, (B, C, H, W).
        radius: R, in pixels of the maps, 0 or more.

    Returns:
        (B, 2 R + 1, H, W).

    Raises:
        InputError: the maps are not a pair, or a negative radius.

    Source: Mayer et al., "A large dataset to train convolutional networks for disparity, optical flow, and scene flow
    estimation", CVPR 2016, section 5.

    >>> signed_correlation(torch.ones(1, 2, 1, 3), torch.tensor([1.0, 2.0, 3.0]).expand(1, 2, 1, 3), 1)[0, :, 0]
    tensor([[0., 1., 2.],
            [1., 2., 3.],
            [2., 3., 0.]])
    """
    check_features(left, right, 1)
    if radius < 0:
        raise InputError(f"radius={radius} of a correlation has to be 0 or more")
    if radius <= FEW:
        # shift by shift: no tiles, whose number torch.export can't reason about at the coarsest scales
        width = right.shape[-1]
        padded, scaled = F.pad(right, (radius, radius)), left / left.shape[1]
        shifted = (padded[..., k : k + width] for k in range(2 * radius + 1))
        return torch.stack([(scaled * other).sum(1) for other in shifted], dim=1)
    # of shifts from -R to R all are to one side, once the right map begins R pixels earlier; and divided first, for
    # sums of products overflow in half precision
    ahead, behind = F.pad(left / left.shape[1], (radius, 0)), F.pad(right, (0, radius))
    return inner_products(ahead, behind, 2 * radius + 1)[..., radius:].flip(1)


class SignedCorrelation(nn.Module):
    """`signed_correlation` as a module.

    Args:
        radius: in pixels of the maps.

    Shape: two (B, C, H, W) to (B, 2 * radius + 1, H, W).

    Raises:
        ConfigError: a negative radius.

    >>> SignedCorrelation(radius=40)(*torch.rand(2, 1, 8, 4, 16)).shape
    torch.Size([1, 81, 4, 16])
    """

    def __init__(self, *, radius: int) -> None:
        super().__init__()
        if radius < 0:
            raise ConfigError(f"radius={radius} of a correlation has to be 0 or more")
        self.radius = radius
        self.out_channels = 2 * radius + 1

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        """Left and right features to a map."""
        return signed_correlation(left, right, self.radius)

    def extra_repr(self) -> str:
        """The radius, for printing."""
        return f"radius={self.radius}"
