"""The concatenation cost volume of GC-Net and PSMNet."""

import torch
from torch import Tensor, nn

from stereokit.costs.projection import Projected, Projection
from stereokit.costs.shift import Planes, check_features, seen_from_left
from stereokit.registry import COSTS

__all__ = ["ConcatenationVolume", "concatenation_volume"]


def concatenation_volume(left: Tensor, right: Tensor, planes: Planes, *, masked: bool = True) -> Tensor:
    """Left features beside the right features that they would match, at every disparity.

    ``C(:, d, y, x) = [l(y, x), r(y, x - d)]``, all 0 where x < d.

    Args:
        left: (B, C, H, W).
        right: (B, C, H, W).
        planes: D, for the disparities 0 ... D - 1, or candidates (B, D, H, W); in pixels of the maps.
        masked: set the left features to 0 too where there is no right one.

    Returns:
        (B, 2C, D, H, W).

    Raises:
        InputError: the maps are not a pair.

    Source: Kendall et al., "End-to-end learning of geometry and context for deep stereo regression", ICCV 2017,
    section 3.2.

    >>> concatenation_volume(torch.ones(1, 1, 1, 3), 2 * torch.ones(1, 1, 1, 3), 2)[0, :, 1, 0]
    tensor([[0., 1., 1.],
            [0., 2., 2.]])
    """
    check_features(left, right, planes)
    shifted, seen = seen_from_left(right, planes)
    repeated = left.unsqueeze(2) * seen if masked else left.unsqueeze(2).expand_as(shifted)
    return torch.cat((repeated, shifted), dim=1)


@COSTS.register("concatenation")
class ConcatenationVolume(nn.Module):
    """`concatenation_volume` of projected features.

    Args:
        in_channels: of the features.
        planes: of disparity.
        projection: widths of the two convolutions before the concatenation, None for none.
        masked: set the left features to 0 too where there is no right one.

    Shape: two (B, in_channels, H, W) to (B, out_channels, planes, H, W), out_channels being twice the projected ones.

    Source: Kendall et al., ICCV 2017, section 3.2; the projection is that of CoEx's ablation.

    >>> ConcatenationVolume(in_channels=32, planes=48).out_channels
    64
    """

    warps = True

    def __init__(self, *, in_channels: int, planes: int, projection: Projected = None, masked: bool = True) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.planes = planes
        self.masked = masked
        self.projection = Projection(in_channels, projection)
        self.out_channels = 2 * self.projection.out_channels

    def forward(self, left: Tensor, right: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Left and right features to a cost volume."""
        left, right = self.projection(left, right)
        planes = self.planes if candidates is None else candidates
        return concatenation_volume(left, right, planes, masked=self.masked)
