"""The concatenation cost volume of GC-Net and PSMNet."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from stereokit.costs.projection import Projection
from stereokit.costs.shift import check_features, shifted_stack
from stereokit.registry import COSTS

__all__ = ["ConcatenationVolume", "concatenation_volume"]


def concatenation_volume(left: Tensor, right: Tensor, levels: int) -> Tensor:
    """Left features beside the right features that they would match, at every disparity.

    ``C(:, d, y, x) = [l(y, x), r(y, x - d)]``, all 0 where x < d.

    Args:
        left: (B, C, H, W).
        right: (B, C, H, W).
        levels: D, the disparities 0 .. D - 1, in pixels of the maps.

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
    check_features(left, right, levels)
    position = torch.arange(left.shape[-1], device=left.device)
    level = torch.arange(levels, device=left.device)
    seen = (position >= level[:, None]).to(left.dtype)[:, None]
    return torch.cat((left.unsqueeze(2) * seen, shifted_stack(right, levels)), dim=1)


@COSTS.register("concatenation")
class ConcatenationVolume(nn.Module):
    """`concatenation_volume` of projected features.

    Args:
        in_channels: of the features.
        levels: of disparity.
        projection: widths of the two convolutions before the concatenation, None for none.

    Shape: two (B, in_channels, H, W) to (B, out_channels, levels, H, W), out_channels being twice the projected ones.

    Source: Kendall et al., ICCV 2017, section 3.2; the projection is that of CoEx's ablation.

    >>> ConcatenationVolume(in_channels=32, levels=48).out_channels
    64
    """

    def __init__(self, *, in_channels: int, levels: int, projection: Sequence[int] | None = None) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.levels = levels
        self.projection = Projection(in_channels, projection)
        self.out_channels = 2 * self.projection.out_channels

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        """Left and right features to a cost volume."""
        left, right = self.projection(left, right)
        return concatenation_volume(left, right, self.levels)
