"""The cost aggregation of GANet: an hourglass of 3D convolutions, once or twice, guided at two scales."""

from collections.abc import Mapping, Sequence

from torch import Tensor, nn

from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.errors import ConfigError
from stereokit.guidance.point import GuidancePlan, GuidancePoint
from stereokit.layers import ConvNormAct, ResampleStep, init_convolutions, relu
from stereokit.registry import AGGREGATIONS

__all__ = ["RepeatedHourglass"]

LOSS_WEIGHTS = {1: (0.4, 1.2), 2: (0.2, 0.6, 1.0)}
"""Of the heads, by the number of passes: of GANet-11 and of GANet-deep."""


class Place(nn.Module):
    """Guidance by a map that is convolved once more at every further place of its scale."""

    def __init__(self, point: GuidancePoint, *, further: bool) -> None:
        super().__init__()
        self.point = point
        self.deepen = nn.ModuleDict(
            {str(stride): ConvNormAct(c, c, activation=relu) for stride, c in point.guide_channels.items() if further}
        )

    def forward(self, volume: Tensor, guides: dict[int, Tensor]) -> Tensor:
        """The volume, guided; the guide of its stride is replaced by the deeper one."""
        for stride, conv in self.deepen.items():
            guides[int(stride)] = conv(guides[int(stride)])
        return self.point(volume, guides)


class Pass(nn.Module):
    """Down by two scales and up again, with guidance at the middle scale on both ways, and at the finest in the end."""

    def __init__(self, widths: tuple[int, int, int], plan: GuidancePlan, *, first: bool) -> None:
        super().__init__()
        c0, c1, c2 = widths
        if first:
            self.down1: nn.Module = ConvNormAct(c0, c1, dims=3, stride=2, activation=relu)
            self.down2: nn.Module = ConvNormAct(c1, c2, dims=3, stride=2, activation=relu)
        else:
            self.down1, self.down2 = ResampleStep(c0, c1, dims=3, up=False), ResampleStep(c1, c2, dims=3, up=False)
        self.guide1 = Place(plan.at(2, c1), further=not first)
        self.up2 = ResampleStep(c2, c1, dims=3, up=True)
        self.guide2 = Place(plan.at(2, c1), further=True)
        self.up1 = ResampleStep(c1, c0, dims=3, up=True, activation=None)
        self.guide3 = Place(plan.at(1, c0), further=True)
        self.first = first

    def forward(self, volumes: list[Tensor], guides: dict[int, Tensor]) -> list[Tensor]:
        """Volumes from fine to coarse, of which the first pass is given the finest, to those of all three scales."""
        fine, *skips = volumes
        half = self.guide1(self.down1(fine, *skips[:1]), guides)
        bottom = self.down2(half, *skips[1:])
        half = self.guide2(self.up2(bottom, half), guides)
        return [self.guide3(self.up1(half, fine), guides), half, bottom]


@AGGREGATIONS.register("repeated_hourglass")
class RepeatedHourglass(nn.Module):
    """A convolution, and an hourglass of two halvings that is passed once or twice, with a head before and after each.

    Guidance at "one" place acts behind the first convolution; "full" adds three places to each pass. The guide of a
    scale is convolved once more from place to place.

    Args:
        in_channels: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; needed at `stride`, and at twice that for "full".
        guidance: makes a guidance block, such as `SemiGlobalGuidance`; None for none.
        guidance_at: "one" or "full".
        passes: through the hourglass; 2 in GANet-deep, 1 in GANet-11.
        channels: of the three scales, from the finest.

    Shape: volume (B, in_channels, D, H, W) and guides by stride to `passes` + 1 tensors (B, D, H, W) of logits, larger
    is better, the best one last; in eval mode to that one alone. D, H and W may be odd: what does not fit is cut.

    Raises:
        ConfigError: another number of passes.

    Source: Zhang et al., "GA-Net: guided aggregation net for end-to-end stereo matching", CVPR 2019, appendix A.

    >>> import torch
    >>> aggregation = RepeatedHourglass(in_channels=4, channels=(2, 3, 4), passes=1)
    >>> [logits.shape[1] for logits in aggregation(torch.rand(2, 4, 9, 8, 16), {})]
    [9, 9]
    """

    multiple = 4
    planes_multiple = 1
    upscale = 1
    volume_heads = ("heads",)

    def __init__(
        self,
        *,
        in_channels: int,
        stride: int = 3,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "full",
        passes: int = 2,
        channels: Sequence[int] = (32, 48, 64),
    ) -> None:
        super().__init__()
        if passes not in LOSS_WEIGHTS:
            raise ConfigError(f"passes={passes!r}: the hourglass is passed {' or '.join(map(str, LOSS_WEIGHTS))} times")
        self.in_channels = in_channels
        c0, c1, c2 = channels
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)
        self.stem = ConvNormAct(in_channels, c0, dims=3, activation=None)
        self.guidance = plan.first(c0)
        self.passes = nn.ModuleList(Pass((c0, c1, c2), plan, first=number == 0) for number in range(passes))
        self.heads = nn.ModuleList(nn.Conv3d(c0, 1, 3, padding=1, bias=False) for _ in range(passes + 1))
        init_convolutions(self.heads)
        self.loss_weights = LOSS_WEIGHTS[passes]
        self.guide_channels = GuidancePlan.guides_read_by(self)

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """Volume and guides to logits."""
        maps = dict(guides)
        volumes = [self.guidance(self.stem(volume), maps)]
        finest = [volumes[0]]
        for once in self.passes:
            volumes = once(volumes, maps)
            finest.append(volumes[0])
        judged = list(zip(self.heads, finest, strict=True))
        return tuple(head(x).squeeze(1) for head, x in (judged if self.training else judged[-1:]))
