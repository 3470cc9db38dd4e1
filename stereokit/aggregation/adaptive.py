"""The cost aggregation of AANet: 2D convolutions within each of three scales, and across them."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.errors import ConfigError
from stereokit.guidance.point import GuidancePlan
from stereokit.layers import Bottleneck, ConvNormAct, init_convolutions, leaky_relu
from stereokit.registry import AGGREGATIONS

__all__ = ["AdaptiveAggregation", "CrossScale"]

leaky = partial(leaky_relu, 0.2)


class CrossScale(nn.Module):
    r"""Each scale gets the sum of all of them, brought to its size and width.

    .. math:: \hat C^s = \sigma \Big( C^s + \sum_{k \ne s} f_{k \to s}(C^k) \Big)

    From a finer scale, f is a strided 3x3 convolution for each halving; from a coarser one a 1x1 convolution, and
    bilinear interpolation. The planes of disparity are the channels.

    Args:
        widths: channels from the finest scale to the coarsest, each half the size of the one before.

    Shape: one (B, widths[s], H / 2^s, W / 2^s) for each scale to the same.

    Source: Xu and Zhang, "AANet: adaptive aggregation network for efficient stereo matching", CVPR 2020, section 3.2,
    equation 5.

    >>> import torch
    >>> fine, coarse = CrossScale((8, 4))([torch.rand(1, 8, 6, 10), torch.rand(1, 4, 3, 5)])
    >>> fine.shape, coarse.shape
    (torch.Size([1, 8, 6, 10]), torch.Size([1, 4, 3, 5]))
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        scales = range(len(widths))
        self.exchange = nn.ModuleList(
            nn.ModuleList(_between(widths, source, target) for source in scales) for target in scales
        )

    def forward(self, volumes: Sequence[Tensor], *, outputs: int | None = None) -> list[Tensor]:
        """Volumes from fine to coarse to as many, or to the first `outputs` of them."""
        summed = []
        sources: Any
        for sources in list(self.exchange)[:outputs]:
            parts = [change(volume) for change, volume in zip(sources, volumes, strict=True)]
            summed.append(F.leaky_relu(sum(parts[1:], start=parts[0]), 0.2))
        return summed


def _between(widths: Sequence[int], source: int, target: int) -> nn.Module:
    """From one scale to another."""
    if source == target:
        return nn.Identity()
    if source > target:
        return nn.Sequential(
            ConvNormAct(widths[source], widths[target], 1, activation=None),
            nn.Upsample(scale_factor=2.0 ** (source - target), mode="bilinear", align_corners=False),
        )
    same = (ConvNormAct(widths[source], widths[source], stride=2, activation=leaky) for _ in range(target - source - 1))
    return nn.Sequential(*same, ConvNormAct(widths[source], widths[target], stride=2, activation=None))


class AdaptiveModule(nn.Module):
    """Aggregation within each scale, by a bottleneck that may sample where it likes, and across them."""

    def __init__(self, widths: Sequence[int], *, deformable: bool) -> None:
        super().__init__()
        self.within = nn.ModuleList(Bottleneck(width, width, width, deformable=deformable) for width in widths)
        self.across = CrossScale(widths)

    def forward(self, volumes: Sequence[Tensor], *, outputs: int | None = None) -> list[Tensor]:
        """Volumes (B, planes, h, w) from fine to coarse to as many, or to the first `outputs` of them."""
        within = [block(volume) for block, volume in zip(self.within, volumes, strict=True)]
        across: list[Tensor] = self.across(within, outputs=outputs)
        return across


@AGGREGATIONS.register("adaptive")
class AdaptiveAggregation(nn.Module):
    """Modules of AANet: a bottleneck within each of three scales, deformable in the last ones, and sums across them.

    All convolutions are 2D: the planes of disparity are the channels. Where the volumes have several channels, a 1x1x1
    convolution first makes one of them. Guidance at "one" place acts on the finest volume ahead of the modules, "full"
    on all three; it sees them as volumes of depth 1.

    Args:
        in_channels: of the volumes.
        planes: of the finest volume: its width. A coarser one has half as many.
        stride: of the finest volume.
        guide_channels: of the guides, by stride; needed at `stride`, twice and four times it for "full".
        guidance: makes a guidance block, such as `GCE`; None for none.
        guidance_at: "one" or "full".
        modules: in a row.
        deformable: of these, how many have deformable convolutions, from the last one back.

    Shape: three volumes (B, in_channels, planes / 2^s, H / 2^s, W / 2^s) and guides by stride to three tensors
    (B, planes / 2^s, H / 2^s, W / 2^s) of logits, larger is better, the finest one last; in eval mode to that alone.

    Raises:
        ConfigError: planes that are no multiple of 8, or more deformable modules than there are.

    Source: Xu and Zhang, "AANet: adaptive aggregation network for efficient stereo matching", CVPR 2020, section 3.

    >>> import torch
    >>> aggregation = AdaptiveAggregation(in_channels=1, planes=16, modules=2, deformable=1)
    >>> volumes = [torch.rand(2, 1, 16 >> s, 16 >> s, 24 >> s) for s in range(3)]
    >>> [tuple(logits.shape) for logits in aggregation(volumes, {})]
    [(2, 4, 4, 6), (2, 8, 8, 12), (2, 16, 16, 24)]
    """

    scales = 3
    multiple = 4
    # the coarsest planes fall into two groups
    planes_multiple = 8
    upscale = 1
    loss_weights = (1 / 3, 2 / 3, 1.0)

    def __init__(
        self,
        *,
        in_channels: int,
        planes: int,
        stride: int = 3,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "one",
        modules: int = 6,
        deformable: int = 3,
    ) -> None:
        super().__init__()
        if planes % self.planes_multiple:
            raise ConfigError(
                f"planes={planes} are halved twice, and at the coarsest scale in two groups: use a multiple of "
                f"{self.planes_multiple}"
            )
        if modules < 1 or not 0 <= deformable <= modules:
            raise ConfigError(f"{deformable} deformable modules of {modules}: expected 0 to all of at least one")
        self.in_channels = in_channels
        widths = [planes >> scale for scale in range(self.scales)]
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)
        self.points = nn.ModuleList(
            plan.at(1 << scale, width) if scale else plan.first(width) for scale, width in enumerate(widths)
        )
        self.join = nn.ModuleList(
            nn.Conv3d(in_channels, 1, 1) if in_channels > 1 else nn.Identity() for _ in range(self.scales)
        )
        init_convolutions(self.join)
        self.stack = nn.ModuleList(
            AdaptiveModule(widths, deformable=number >= modules - deformable) for number in range(modules)
        )
        self.heads = nn.ModuleList(nn.Conv2d(width, width, 1) for width in widths)
        self.guide_channels = GuidancePlan.guides_read_by(self)

    def forward(self, volumes: Sequence[Tensor], guides: Guides) -> tuple[Tensor, ...]:
        """Volumes from fine to coarse, and guides, to logits from coarse to fine."""
        maps = [
            point.on_maps(join(volume).squeeze(1), guides)  # type: ignore[operator]
            for point, join, volume in zip(self.points, self.join, volumes, strict=True)
        ]
        *first, last = self.stack
        for module in first:
            maps = module(maps)
        maps = last(maps, outputs=None if self.training else 1)
        return tuple(head(x) for head, x in reversed(list(zip(self.heads, maps, strict=False))))
