"""The cost aggregation of GwcNet: three hourglasses whose width doubles with every halving."""

from collections.abc import Mapping

import torch.nn.functional as F
from torch import Tensor, nn

from stereokit.aggregation.logits_head import logits_head
from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.guidance.point import GuidancePlan
from stereokit.layers import Activation, ConvNormAct, crop_to, relu
from stereokit.registry import AGGREGATIONS

__all__ = ["DoublingHourglass", "GwcHourglass"]


class DoublingHourglass(nn.Module):
    """Two halvings and back; each doubles the width, and 1x1x1 convolutions skip them.

    Args:
        channels: of the volume.
        plan: of the guidance at half, quarter and half its size; None for none.

    Shape: (B, channels, D, H, W) to the same.

    >>> import torch
    >>> DoublingHourglass(8)(torch.rand(1, 8, 4, 8, 12), {}).shape
    torch.Size([1, 8, 4, 8, 12])
    """

    def __init__(self, channels: int, plan: GuidancePlan | None = None) -> None:
        super().__init__()
        plan = plan or GuidancePlan(None, "one", 1, None)
        c1, c2, c4 = channels, 2 * channels, 4 * channels
        self.conv1 = ConvNormAct(c1, c2, dims=3, stride=2, activation=relu)
        self.conv2 = ConvNormAct(c2, c2, dims=3, activation=relu)
        self.conv3 = ConvNormAct(c2, c4, dims=3, stride=2, activation=relu)
        self.conv4 = ConvNormAct(c4, c4, dims=3, activation=relu)
        self.conv5 = ConvNormAct(c4, c2, dims=3, stride=2, transposed=True, activation=None)
        self.conv6 = ConvNormAct(c2, c1, dims=3, stride=2, transposed=True, activation=None)
        self.skip1 = ConvNormAct(c1, c1, 1, dims=3, activation=None)
        self.skip2 = ConvNormAct(c2, c2, 1, dims=3, activation=None)
        self.down_guidance, self.bottom_guidance, self.up_guidance = plan.at(2, c2), plan.at(4, c4), plan.at(2, c2)

    def forward(self, x: Tensor, guides: Guides) -> Tensor:
        """Volume and guides to a volume."""
        half = self.down_guidance(self.conv2(self.conv1(x)), guides)
        bottom = self.bottom_guidance(self.conv4(self.conv3(half)), guides)
        up = F.relu(crop_to(self.conv5(bottom), half) + self.skip2(half))
        up = self.up_guidance(up, guides)
        return F.relu(crop_to(self.conv6(up), x) + self.skip1(x))


@AGGREGATIONS.register("gwc_hourglass")
class GwcHourglass(nn.Module):
    """Two residual pairs of convolutions, three hourglasses in a row and four heads, the first three for training.

    Guidance at "one" place acts after the first pair; "full" adds the three places inside each hourglass.

    Args:
        in_channels: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; needed at `stride`, twice and four times it for "full".
        guidance: makes a guidance block, such as `GCE`; None for none.
        guidance_at: "one" or "full".
        channels: of the volumes at the finest scale.

    Shape: volume (B, in_channels, D, H, W) and guides by stride to four tensors (B, D, H, W) of logits, larger is
    better, the best one last; in eval mode to that one alone.

    Source: Guo et al., "Group-wise correlation stereo network", CVPR 2019, section 3.3.

    >>> import torch
    >>> gwc = GwcHourglass(in_channels=40, channels=8)
    >>> len(gwc(torch.rand(2, 40, 8, 16, 16), {})), gwc.eval()(torch.rand(1, 40, 8, 16, 16), {})[-1].shape
    (4, torch.Size([1, 8, 16, 16]))
    """

    multiple = planes_multiple = 4
    upscale = 1
    loss_weights = (0.5, 0.5, 0.7, 1.0)
    volume_heads = ("head0", "head1", "head2", "head3")

    def __init__(
        self,
        *,
        in_channels: int,
        stride: int = 4,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "one",
        channels: int = 32,
    ) -> None:
        super().__init__()
        self.in_channels = in_channels
        c = channels
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)

        def conv(width: int = c, activation: Activation | None = relu) -> ConvNormAct:
            return ConvNormAct(width, c, dims=3, activation=activation)

        self.pair0 = nn.Sequential(conv(in_channels), conv())
        self.guidance = plan.first(c)
        self.pair1 = nn.Sequential(conv(), conv(activation=None))
        self.hourglass1, self.hourglass2, self.hourglass3 = (DoublingHourglass(c, plan) for _ in range(3))
        self.head0, self.head1, self.head2, self.head3 = (logits_head(c) for _ in range(4))
        self.guide_channels = GuidancePlan.guides_read_by(self)

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """Volume and guides to logits."""
        x = self.guidance(self.pair0(volume), guides)
        x0 = self.pair1(x) + x
        x1 = self.hourglass1(x0, guides)
        x2 = self.hourglass2(x1, guides)
        x3 = self.hourglass3(x2, guides)
        if not self.training:
            return (self.head3(x3).squeeze(1),)
        heads = (self.head0(x0), self.head1(x1), self.head2(x2), self.head3(x3))
        return tuple(logits.squeeze(1) for logits in heads)
