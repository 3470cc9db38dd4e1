"""The feature extractor of AANet+: GA-Net's double hourglass at stride 3, and two strided steps behind it."""

from functools import partial

from torch import Tensor, nn

from stereokit.contracts import FeatureInfo, Features
from stereokit.errors import ConfigError
from stereokit.layers import ConvNormAct, DeformableConvolution, TwofoldHourglass, leaky_relu, relu
from stereokit.registry import BACKBONES

__all__ = ["DeformableHourglass"]


@BACKBONES.register("deformable_hourglass")
class DeformableHourglass(nn.Module):
    """Convolutions to stride 3, a `TwofoldHourglass` there, and strided convolutions to strides 6 and 12.

    Args:
        deformable: whether some of the convolutions are deformable.
        scales: of which there are maps, from the finest: 1 for networks that compare at one scale.

    Shape: (B, 3, H, W), sides multiples of 48, to `Features`: matching and guides {3: 32, 6: 64, 12: 128}.

    Raises:
        ConfigError: no such number of scales.

    Source: haofeixu/aanet, the authors' AANet+; the hourglass is that of Zhang et al., "GA-Net: guided aggregation net
    for end-to-end stereo matching", CVPR 2019.

    >>> import torch
    >>> maps = DeformableHourglass(deformable=False).eval()(torch.rand(1, 3, 48, 96)).matching
    >>> {stride: tuple(x.shape) for stride, x in maps.items()}
    {3: (1, 32, 16, 32), 6: (1, 64, 8, 16), 12: (1, 128, 4, 8)}
    """

    multiple = 48

    def __init__(self, *, deformable: bool = True, scales: int = 3) -> None:
        super().__init__()
        if scales not in (1, 2, 3):
            raise ConfigError(f"scales={scales!r}: a double hourglass gives maps of 1, 2 or 3 scales")
        self.stem = nn.Sequential(
            ConvNormAct(3, 32, activation=relu),
            ConvNormAct(32, 32, 5, stride=3, activation=relu),
            DeformableConvolution(32, 32) if deformable else ConvNormAct(32, 32, activation=relu),
        )
        self.hourglass = TwofoldHourglass(deformable=deformable)
        leaky = partial(leaky_relu, 0.2)
        self.coarser = nn.ModuleList(
            nn.Sequential(
                ConvNormAct(width, 2 * width, stride=2, activation=leaky),
                ConvNormAct(2 * width, 2 * width, 1, activation=leaky),
            )
            for width in (32, 64)[: scales - 1]
        )
        widths = {3 << scale: 32 << scale for scale in range(scales)}
        self.info = FeatureInfo(matching_channels=widths, guide_channels=widths)

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        maps = [self.hourglass(self.stem(images))]
        for step in self.coarser:
            maps.append(step(maps[-1]))
        matching = {3 << scale: x for scale, x in enumerate(maps)}
        return Features(matching=matching, guides=matching)
