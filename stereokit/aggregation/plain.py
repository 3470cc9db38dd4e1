"""The cost aggregation of StereoNet: 3D convolutions in a row, at one scale."""

from collections.abc import Mapping
from functools import partial

from torch import Tensor, nn

from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.guidance.point import GuidancePlan
from stereokit.layers import ConvNormAct, leaky_relu
from stereokit.registry import AGGREGATIONS

__all__ = ["PlainAggregation"]


@AGGREGATIONS.register("plain")
class PlainAggregation(nn.Module):
    """3x3x3 convolutions at the volume's own scale.

    Guidance at "one" place acts behind the first convolution, "full" behind each but the last, which gives the logits.

    Args:
        in_channels: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; the one at `stride` is needed where there is guidance.
        guidance: makes a guidance block, such as `GCE`; None for none.
        guidance_at: "one" or "full".
        channels: of every layer.
        layers: convolutions with norm and activation, at least one.

    Shape: volume (B, in_channels, D, H, W) and guides by stride to one tensor (B, D, H, W) of logits, larger is better.

    Source: Khamis et al., "StereoNet: guided hierarchical refinement for real-time edge-aware depth prediction",
    ECCV 2018, section 3.2.

    >>> import torch
    >>> PlainAggregation(in_channels=32)(torch.rand(1, 32, 12, 8, 16), {})[-1].shape
    torch.Size([1, 12, 8, 16])
    """

    multiple = planes_multiple = 1
    upscale = 1
    loss_weights = (1.0,)
    volume_heads = ("head",)

    def __init__(
        self,
        *,
        in_channels: int,
        stride: int = 8,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "one",
        channels: int = 32,
        layers: int = 4,
    ) -> None:
        super().__init__()
        self.in_channels = in_channels
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)
        # the bias ahead of the norm has no effect, but published weights have it
        conv = partial(ConvNormAct, dims=3, bias=True, activation=partial(leaky_relu, 0.2))
        self.layers = nn.ModuleList(conv(channels if number else in_channels, channels) for number in range(layers))
        self.points = nn.ModuleList(
            plan.at(1, channels) if number else plan.first(channels) for number in range(layers)
        )
        # the initialisation of PyTorch, so that no candidate stands out at first
        self.head = nn.Conv3d(channels, 1, 3, padding=1)
        self.guide_channels = GuidancePlan.guides_read_by(self)

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """Volume and guides to logits."""
        for layer, point in zip(self.layers, self.points, strict=True):
            volume = point(layer(volume), guides)
        return (self.head(volume).squeeze(1),)
