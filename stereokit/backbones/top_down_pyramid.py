"""Matching features at several strides, from coarse to fine."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import Backbone, FeatureInfo, Features
from stereokit.errors import ConfigError
from stereokit.layers import init_convolutions
from stereokit.registry import BACKBONES

__all__ = ["TopDownPyramid"]


@BACKBONES.register("top_down_pyramid")
class TopDownPyramid(nn.Module):
    """The coarsest matching features of another backbone, carried down to finer strides, for cascades.

    On the way from a stride to half of it, the map is doubled by repetition, and the guide of that stride is added
    through a 1x1 convolution. What is matched there comes out of a plain 3x3 convolution, with half of the channels.

    Args:
        base: a backbone, by name or as ``{"name": ..., **arguments}``, with guides down to `finest`.
        finest: the last stride.
        smooth: a plain 3x3 convolution at the coarsest stride too; else its features are matched as they are.
        pretrained: load timm's weights for the encoder of the base.

    Shape: (B, 3, H, W), sides multiples of those of the base, to `Features`: matching (B, C, H/s, W/s) of the base and
    (B, C / 2, 2H/s, 2W/s), ... down to `finest`; guides of the base, down to there.

    Raises:
        ConfigError: a base that can't be built, or has no guide at one of the strides.

    Source: Gu et al., "Cascade cost volume for high-resolution multi-view stereo and stereo matching", CVPR 2020,
    "Feature pyramid"; Lin et al., "Feature pyramid networks for object detection", CVPR 2017.

    >>> import torch
    >>> pyramid = TopDownPyramid(base="spatial_pyramid")
    >>> {s: tuple(m.shape[1:]) for s, m in pyramid.eval()(torch.rand(1, 3, 64, 96)).matching.items()}
    {4: (32, 16, 24), 2: (16, 32, 48)}
    """

    def __init__(
        self, *, base: str | Mapping[str, Any], finest: int = 2, smooth: bool = True, pretrained: bool = False
    ) -> None:
        super().__init__()
        name, arguments = BACKBONES.named(base, "the base of a pyramid is the name of a backbone")
        if pretrained and "pretrained" not in BACKBONES.parameters(name):
            raise ConfigError(f"backbone {name!r} has no pretrained weights to load; leave out pretrained_backbone")
        self.base: Backbone = BACKBONES.build(name, arguments, {"pretrained": pretrained})
        given = self.base.info
        self.coarsest = max(given.matching_channels)
        channels = given.matching_channels[self.coarsest]
        self.strides = [
            self.coarsest >> i for i in range(1, self.coarsest.bit_length()) if self.coarsest >> i >= finest
        ]
        lacking = [s for s in self.strides if s not in given.guide_channels]
        if not self.strides or self.strides[-1] != finest or lacking:
            raise ConfigError(
                f"a pyramid from stride {self.coarsest} to finest={finest} wants guides at each stride down to there, "
                f"but backbone {name!r} has them at {', '.join(map(str, sorted(given.guide_channels)))}"
            )
        matching = {self.coarsest: channels} | {s: channels * s // self.coarsest for s in self.strides}
        self.laterals = nn.ModuleDict({str(s): nn.Conv2d(given.guide_channels[s], channels, 1) for s in self.strides})
        smoothed = [self.coarsest, *self.strides] if smooth else self.strides
        self.heads = nn.ModuleDict(
            {str(s): nn.Conv2d(channels, matching[s], 3, padding=1, bias=False) for s in smoothed}
        )
        init_convolutions(self.laterals)
        init_convolutions(self.heads)
        self.multiple = self.base.multiple
        guides = {s: c for s, c in given.guide_channels.items() if s >= finest}
        self.info = FeatureInfo(matching_channels=matching, guide_channels=guides)

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        given = self.base(images)
        carried = {self.coarsest: given.matching[self.coarsest]}
        for stride in self.strides:
            doubled = F.interpolate(carried[2 * stride], scale_factor=2, mode="nearest")
            carried[stride] = doubled + self.laterals[str(stride)](given.guides[stride])
        matching = {s: self.heads[str(s)](x) if str(s) in self.heads else x for s, x in carried.items()}
        return Features(matching=matching, guides={s: given.guides[s] for s in self.info.guide_channels})
