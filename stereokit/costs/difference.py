"""The difference cost volume of StereoNet."""

from torch import Tensor, nn

from stereokit.costs.projection import Projected, Projection
from stereokit.costs.shift import Planes, check_features, seen_from_left
from stereokit.registry import COSTS

__all__ = ["DifferenceVolume", "difference_volume"]


def difference_volume(left: Tensor, right: Tensor, planes: Planes, *, absolute: bool = False) -> Tensor:
    """Left features less the right features that they would match, at every disparity.

    ``C(:, d, y, x) = l(y, x) - r(y, x - d)``, 0 where x < d.

    Args:
        left: (B, C, H, W).
        right: (B, C, H, W).
        planes: D, for the disparities 0 ... D - 1, or candidates (B, D, H, W); in pixels of the maps.
        absolute: without the sign.

    Returns:
        (B, C, D, H, W).

    Raises:
        InputError: the maps are not a pair.

    Source: Khamis et al., "StereoNet: guided hierarchical refinement for real-time edge-aware depth prediction",
    ECCV 2018, section 3.1.

    >>> import torch
    >>> difference_volume(torch.ones(1, 1, 1, 3), 2 * torch.ones(1, 1, 1, 3), 2)[0, 0, :, 0]
    tensor([[-1., -1., -1.],
            [ 0., -1., -1.]])
    """
    check_features(left, right, planes)
    shifted, seen = seen_from_left(right, planes)
    difference = (left.unsqueeze(2) - shifted) * seen
    return difference.abs() if absolute else difference


@COSTS.register("difference")
class DifferenceVolume(nn.Module):
    """`difference_volume` of projected features.

    Args:
        in_channels: of the features.
        planes: of disparity.
        projection: of the features before they are compared, see `Projection`.
        absolute: without the sign.

    Shape: two (B, in_channels, H, W) to (B, out_channels, planes, H, W).

    Source: Khamis et al., ECCV 2018, section 3.1.

    >>> DifferenceVolume(in_channels=32, planes=24).out_channels
    32
    """

    warps = True

    def __init__(self, *, in_channels: int, planes: int, projection: Projected = None, absolute: bool = False) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.planes = planes
        self.absolute = absolute
        self.projection = Projection(in_channels, projection)
        self.out_channels = self.projection.out_channels

    def forward(self, left: Tensor, right: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Left and right features to a cost volume."""
        left, right = self.projection(left, right)
        return difference_volume(left, right, self.planes if candidates is None else candidates, absolute=self.absolute)
