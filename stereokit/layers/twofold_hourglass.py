"""Two 2D hourglasses in a row, each of whose scales reads the one before."""

from itertools import pairwise

from torch import Tensor, nn

from stereokit.layers.convolution import ConvNormAct, relu
from stereokit.layers.deformable import DeformableConvolution
from stereokit.layers.resample_step import ResampleStep

__all__ = ["TwofoldHourglass"]


class TwofoldHourglass(nn.Module):
    """Down by 16 and up again, twice. Each step reads the latest map of its scale besides.

    Args:
        widths: of the maps, from the finest to the coarsest scale.
        deformable: whether the convolutions that end at the two coarsest scales are `DeformableConvolution`s, as in
            AANet+.

    Shape: (B, widths[0], H, W), sides multiples of 2^(number of widths - 1), to the same.

    Source: the feature extractor of Zhang et al., "GA-Net: guided aggregation net for end-to-end stereo matching",
    CVPR 2019; deformable in the authors' AANet+ (haofeixu/aanet).

    >>> import torch
    >>> TwofoldHourglass((4, 8, 12))(torch.rand(1, 4, 8, 12)).shape
    torch.Size([1, 4, 8, 12])
    """

    def __init__(self, widths: tuple[int, ...] = (32, 48, 64, 96, 128), *, deformable: bool = False) -> None:
        super().__init__()
        steps = list(pairwise(widths))
        bends = [deformable and number >= len(steps) - 2 for number in range(len(steps))]
        self.multiple = 2 ** len(steps)
        self.down1 = nn.ModuleList(
            DeformableConvolution(fine, coarse, stride=2)
            if bent
            else ConvNormAct(fine, coarse, stride=2, activation=relu)
            for (fine, coarse), bent in zip(steps, bends, strict=True)
        )
        self.up1 = nn.ModuleList(ResampleStep(coarse, fine, up=True) for fine, coarse in reversed(steps))
        self.down2 = nn.ModuleList(ResampleStep(fine, coarse, up=False) for fine, coarse in steps)
        for (_, coarse), step, bent in zip(steps, self.down2, bends, strict=True):
            if bent:
                step.merge = DeformableConvolution(2 * coarse, coarse)
        self.up2 = nn.ModuleList(ResampleStep(coarse, fine, up=True) for fine, coarse in reversed(steps))

    def forward(self, x: Tensor) -> Tensor:
        """Maps to maps."""
        latest = [x]
        for down in self.down1:
            latest.append(down(latest[-1]))
        self._climb(self.up1, latest)
        for scale, step in enumerate(self.down2, start=1):
            latest[scale] = step(latest[scale - 1], latest[scale])
        self._climb(self.up2, latest)
        return latest[0]

    def _climb(self, steps: nn.ModuleList, latest: list[Tensor]) -> None:
        """From the coarsest scale to the finest; what is left at each takes the place of what was there."""
        for scale, step in zip(reversed(range(len(steps))), steps, strict=True):
            latest[scale] = step(latest[scale + 1], latest[scale])
