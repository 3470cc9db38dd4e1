"""Guidance by affinity: the image decides which neighbours of a voxel belong together (CSPN)."""

from typing import Literal

from torch import Tensor, nn

from stereokit.guidance.shapes import check_guide
from stereokit.layers import AffinityCentre, affinity_convolution, affinity_propagate, check_affinity
from stereokit.registry import GUIDANCE

__all__ = ["AffinityGuidance"]


@GUIDANCE.register("affinity")
class AffinityGuidance(nn.Module):
    r"""The volume spreads along `affinity_propagate`, by weights that the image decides and all planes share.

    .. math:: C_o = \mathrm{CSPN}(C_i, W * I)

    Args:
        guide_channels: of the image features I.
        volume_channels: of the cost volume.
        dims: 2 to spread within each plane, 3 to the planes beside it as well.
        steps: of the propagation; the authors' demonstrations have 24.
        signed: see `affinity_weights`.
        centre: see `affinity_propagate`.

    Shape: volume (B, volume_channels, D, H, W) and guide (B, guide_channels, H, W) to the volume's shape.

    Raises:
        ConfigError: another number of dimensions, no step, or another centre.
        InputError: in its forward, volume and guide of other channels, or of sizes that differ.

    Source: Cheng et al., "Learning depth with convolutional spatial propagation network", TPAMI 2019.

    >>> import torch
    >>> block = AffinityGuidance(guide_channels=96, volume_channels=8)
    >>> block(torch.rand(1, 8, 12, 16, 32), torch.rand(1, 96, 16, 32)).shape
    torch.Size([1, 8, 12, 16, 32])
    """

    def __init__(
        self,
        guide_channels: int,
        volume_channels: int,
        *,
        dims: Literal[2, 3] = 2,
        steps: int = 4,
        signed: bool = True,
        centre: AffinityCentre = "input",
    ) -> None:
        super().__init__()
        check_affinity(dims, steps, centre)
        self.guide_channels = guide_channels
        self.volume_channels = volume_channels
        self.dims = dims
        self.steps = steps
        self.signed = signed
        self.centre: AffinityCentre = centre
        self.affinity = affinity_convolution(guide_channels, 3**dims - (centre != "own"), 2)

    def forward(self, volume: Tensor, guide: Tensor) -> Tensor:
        """Volume and guide to a volume."""
        check_guide(volume, guide, self.volume_channels, self.guide_channels)
        affinity = self.affinity(guide)
        if self.dims == 3:
            affinity = affinity.unsqueeze(2)
            return affinity_propagate(volume, affinity, steps=self.steps, signed=self.signed, centre=self.centre)
        # the planes as channels
        maps = volume.flatten(1, 2)
        spread = affinity_propagate(maps, affinity, steps=self.steps, signed=self.signed, centre=self.centre)
        return spread.reshape(volume.shape)
