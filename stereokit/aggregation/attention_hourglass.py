"""The aggregation of Fast-ACVNet's attention: a small hourglass on a coarse volume, enlarged afterwards."""

from collections.abc import Mapping, Sequence

from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.aggregation.hourglass import Down, Up
from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.guidance.point import GuidancePlan
from stereokit.layers import ConvNormAct, crop_to, init_convolutions
from stereokit.registry import AGGREGATIONS

__all__ = ["AttentionHourglass"]


@AGGREGATIONS.register("attention_hourglass")
class AttentionHourglass(nn.Module):
    """Hourglass of two halvings at a coarse stride; its logits are doubled in all three dimensions.

    Each plane and channel of the volume is smoothed by itself first, by a depth-wise 1x3x3 convolution.

    Args:
        in_channels: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; needed at `stride`, twice and four times it for "full".
        guidance: makes a guidance block, such as `GCE`; None for none.
        guidance_at: "one" guides the smoothed volume only, "full" the output of every stage too.
        channels: of the two scales below; None for twice and four times `in_channels`.

    Shape: volume (B, in_channels, D, H, W) and guides {stride: (B, G, H * stride0 / stride, ...)} to one tensor
    (B, 2D, 2H, 2W) of logits, larger is better. D, H and W may be odd: what does not fit is cut.

    Source: Xu et al., "Accurate and efficient stereo matching via attention concatenation volume", TPAMI 2023,
    "Fast-ACV".

    >>> import torch
    >>> hourglass = AttentionHourglass(in_channels=12, stride=8)
    >>> hourglass(torch.rand(1, 12, 8, 16, 24), {})[-1].shape
    torch.Size([1, 16, 32, 48])
    """

    multiple = planes_multiple = 4
    upscale = 2
    loss_weights = (1.0,)
    volume_heads = ("head",)

    def __init__(
        self,
        *,
        in_channels: int,
        stride: int = 8,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "full",
        channels: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        self.in_channels = c0 = in_channels
        c1, c2 = (2 * c0, 4 * c0) if channels is None else channels
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)

        self.smooth = nn.Conv3d(c0, c0, (1, 3, 3), padding=(0, 1, 1), groups=c0, bias=False)
        self.stem_guidance = plan.first(c0)
        self.down1 = Down(c0, c1, plan.at(2, c1))
        self.down2 = Down(c1, c2, plan.at(4, c2))
        self.up2 = Up(c2, c1, plan.at(2, c1))
        self.up1 = ConvNormAct(c1, c0, 4, dims=3, stride=2, transposed=True)
        self.head = nn.Conv3d(c0, 1, 3, padding=1, bias=False)
        init_convolutions(self.smooth)
        init_convolutions(self.head)
        self.guide_channels = GuidancePlan.guides_read_by(self)

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """Volume and guides to logits."""
        x = self.stem_guidance(self.smooth(volume), guides)
        x1 = self.down1(x, guides)
        x2 = self.down2(x1, guides)
        x1 = self.up2(x2, x1, guides)
        logits = self.head(crop_to(self.up1(x1), volume))
        return (F.interpolate(logits, scale_factor=2, mode="trilinear", align_corners=False).squeeze(1),)
