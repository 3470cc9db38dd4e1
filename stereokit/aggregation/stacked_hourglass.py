"""The cost aggregation of PSMNet: three hourglasses in a row, each with an output of its own."""

from collections.abc import Mapping
from functools import partial
from typing import Literal

import torch.nn.functional as F
from torch import Tensor, nn

from stereokit.aggregation.logits_head import logits_head
from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.errors import ConfigError
from stereokit.guidance.point import GuidancePlan, GuidancePoint
from stereokit.layers import ConvNormAct, crop_to, relu
from stereokit.registry import AGGREGATIONS

__all__ = ["StackedHourglass"]


class HourglassStage(nn.Module):
    """One of the three: two halvings and back, tied to its predecessors at half the size of the volume."""

    def __init__(self, channels: int, inner_guidance: tuple[GuidancePoint, GuidancePoint, GuidancePoint]) -> None:
        super().__init__()
        wide = 2 * channels
        self.conv1 = ConvNormAct(channels, wide, dims=3, stride=2, activation=relu)
        self.conv2 = ConvNormAct(wide, wide, dims=3, activation=None)
        self.conv3 = ConvNormAct(wide, wide, dims=3, stride=2, activation=relu)
        self.conv4 = ConvNormAct(wide, wide, dims=3, activation=relu)
        self.conv5 = ConvNormAct(wide, wide, dims=3, stride=2, transposed=True, activation=None)
        self.conv6 = ConvNormAct(wide, channels, dims=3, stride=2, transposed=True, activation=None)
        self.pre_guidance, self.bottom_guidance, self.post_guidance = inner_guidance

    def forward(
        self, x: Tensor, guides: Guides, pre: Tensor | None = None, post: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The volume, `pre` of the first hourglass and `post` of the last one, to the output and its own two."""
        own_pre = self.conv2(self.conv1(x))
        own_pre = F.relu(own_pre if post is None else own_pre + post)
        own_pre = self.pre_guidance(own_pre, guides)
        bottom = self.bottom_guidance(self.conv4(self.conv3(own_pre)), guides)
        up = crop_to(self.conv5(bottom), own_pre)
        own_post = F.relu(up + (own_pre if pre is None else pre))
        own_post = self.post_guidance(own_post, guides)
        return crop_to(self.conv6(own_post), x), own_pre, own_post


@AGGREGATIONS.register("stacked_hourglass")
class StackedHourglass(nn.Module):
    """Two residual pairs of convolutions, three hourglasses and three heads, each head adding to the one before.

    A volume of one channel passes a stem first, as in CoEx's ablation with correlation. Guidance at "one" place acts
    after the stem or, where there is none, after the first pair; "full" adds the three places inside each hourglass.

    Args:
        in_channels: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; needed at `stride`, twice and four times it for "full".
        guidance: makes a guidance block, such as `GCE`; None for none.
        guidance_at: "one" or "full".
        channels: of the volumes at the finest scale.
        stem: a convolution ahead of everything; None for one if the volume has a single channel.
        bias: of the pairs, and of the first convolution of each head, ahead of their norms, as in AcfNet.
        third_takes: the hourglass whose volume at half the size the third one adds to its own on the way up: 1 as in
            PSMNet, or 2 as in AcfNet.

    Shape: volume (B, in_channels, D, H, W) and guides by stride to three tensors (B, D, H, W) of logits, larger is
    better, the best one last; in eval mode to that one alone.

    Raises:
        ConfigError: another hourglass.

    Source: Chang and Chen, "Pyramid Stereo Matching Network", CVPR 2018, section 3.4 and table 1.

    >>> import torch
    >>> psm = StackedHourglass(in_channels=64, channels=8)
    >>> [logits.shape for logits in psm(torch.rand(2, 64, 8, 16, 16), {})]
    [torch.Size([2, 8, 16, 16]), torch.Size([2, 8, 16, 16]), torch.Size([2, 8, 16, 16])]
    """

    multiple = planes_multiple = 4
    upscale = 1
    loss_weights = (0.5, 0.7, 1.0)
    volume_heads = ("head1", "head2", "head3")

    def __init__(
        self,
        *,
        in_channels: int,
        stride: int = 4,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "one",
        channels: int = 32,
        stem: bool | None = None,
        bias: bool = False,
        third_takes: Literal[1, 2] = 1,
    ) -> None:
        super().__init__()
        if third_takes not in (1, 2):
            raise ConfigError(f"third_takes={third_takes!r}: the third hourglass adds to its own that of 1 or 2")
        self.third_takes = third_takes
        self.in_channels = in_channels
        c = channels
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)

        def hourglass() -> HourglassStage:
            return HourglassStage(c, (plan.at(2, 2 * c), plan.at(4, 2 * c), plan.at(2, 2 * c)))

        has_stem = in_channels == 1 if stem is None else stem
        self.stem = ConvNormAct(in_channels, c, dims=3) if has_stem else None
        self.guidance = plan.first(c)
        conv = partial(ConvNormAct, dims=3, bias=bias)
        self.pair0 = nn.Sequential(
            conv(c if has_stem else in_channels, c, activation=relu), conv(c, c, activation=relu)
        )
        self.pair1 = nn.Sequential(conv(c, c, activation=relu), conv(c, c, activation=None))
        self.hourglass1, self.hourglass2, self.hourglass3 = hourglass(), hourglass(), hourglass()
        self.head1, self.head2, self.head3 = (logits_head(c, bias=bias) for _ in range(3))
        self.guide_channels = GuidancePlan.guides_read_by(self)

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """Volume and guides to logits."""
        if self.stem is None:
            x = self.guidance(self.pair0(volume), guides)
        else:
            x = self.pair0(self.guidance(self.stem(volume), guides))
        x = self.pair1(x) + x

        out1, pre1, post1 = self.hourglass1(x, guides)
        out1 = out1 + x
        out2, pre2, post2 = self.hourglass2(out1, guides, pre1, post1)
        out2 = out2 + x
        out3, _, _ = self.hourglass3(out2, guides, pre1 if self.third_takes == 1 else pre2, post2)
        out3 = out3 + x

        logits1 = self.head1(out1)
        logits2 = self.head2(out2) + logits1
        logits3 = self.head3(out3) + logits2
        heads = (logits1, logits2, logits3) if self.training else (logits3,)
        return tuple(logits.squeeze(1) for logits in heads)
