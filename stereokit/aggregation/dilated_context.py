"""The context module of HD3 and PWC-Net: 2D convolutions whose dilations grow, over costs and image features."""

from collections.abc import Mapping, Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.errors import ConfigError
from stereokit.guidance.point import GuidancePlan
from stereokit.layers import ConvNormAct, relu
from stereokit.registry import AGGREGATIONS

__all__ = ["DILATIONS", "DilatedContext", "dilated_layers"]

DILATIONS = (1, 1, 2, 4, 8, 16, 1)


def dilated_layers(in_channels: int, channels: int = 128, dilations: Sequence[int] = DILATIONS) -> nn.Sequential:
    """3x3 convolutions at one scale, each with a dilation of its own; by default a pixel sees 33 to each side.

    Args:
        in_channels: of the input.
        channels: of every layer.
        dilations: of the layers, one or more.

    Source: Sun et al., "PWC-Net: CNNs for optical flow using pyramid, warping, and cost volume", CVPR 2018, section 3.

    >>> dilated_layers(9, 4, (1, 2))(torch.rand(1, 9, 5, 6)).shape
    torch.Size([1, 4, 5, 6])
    """
    widths = (in_channels, *([channels] * len(dilations)))
    return nn.Sequential(
        *(
            ConvNormAct(given, width, dilation=dilation, activation=relu)
            for (given, width), dilation in zip(pairwise(widths), dilations, strict=True)
        )
    )


@AGGREGATIONS.register("dilated_context")
class DilatedContext(nn.Module):
    """Planes and image features, side by side as channels, through 3x3 convolutions of growing dilation.

    It has no 3D convolution, and stays at the scale of the volume. The guide of that scale is read where there is one.
    Guidance acts behind the first convolution; at "full" scale behind all others too.

    Args:
        in_channels: of the cost volume.
        planes: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride.
        guidance: makes a guidance block, such as `GCE`; None for none. It sees the maps as volumes of depth 1.
        guidance_at: "one" or "full".
        channels: of every layer.
        dilations: of the layers, one or more.

    Shape: volume (B, in_channels, planes, H, W) and guides by stride to one tensor (B, planes, H, W) of logits, larger
    is better.

    Raises:
        ConfigError: no layer, or a dilation that is not positive.

    Source: Yin et al., "Hierarchical discrete distribution decomposition for match density estimation", CVPR 2019,
    section 4; Sun et al., "PWC-Net", CVPR 2018, section 3.

    >>> context = DilatedContext(in_channels=1, planes=12, guide_channels={4: 24}, channels=16)
    >>> context(torch.rand(1, 1, 12, 16, 24), {4: torch.rand(1, 24, 16, 24)})[-1].shape
    torch.Size([1, 12, 16, 24])
    """

    multiple = planes_multiple = 1
    upscale = 1
    loss_weights = (1.0,)

    def __init__(
        self,
        *,
        in_channels: int,
        planes: int,
        stride: int = 4,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "one",
        channels: int = 128,
        dilations: Sequence[int] = DILATIONS,
    ) -> None:
        super().__init__()
        if not dilations or min(dilations) < 1:
            raise ConfigError(f"dilations={tuple(dilations)!r}: give one or more whole numbers from 1 up")
        self.in_channels = in_channels
        self.guided_by = stride if stride in (guide_channels or {}) else None
        image = (guide_channels or {}).get(stride, 0)
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)
        self.layers = dilated_layers(in_channels * planes + image, channels, dilations)
        self.points = nn.ModuleList(
            plan.at(1, channels) if number else plan.first(channels) for number in range(len(dilations))
        )
        self.head = nn.Conv2d(channels, planes, 1)
        self.guide_channels = GuidancePlan.guides_read_by(self) | ({stride: image} if image else {})

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """Volume and guides to logits."""
        x = volume.flatten(1, 2)
        if self.guided_by is not None:
            x = torch.cat((x, guides[self.guided_by]), dim=1)
        for layer, point in zip(self.layers, self.points, strict=True):
            x = point(layer(x).unsqueeze(2), guides).squeeze(2)
        return (self.head(x),)
