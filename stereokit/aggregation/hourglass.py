"""The cost aggregation of CoEx: one small hourglass, guided at every scale."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor, nn

from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.errors import ConfigError
from stereokit.guidance.point import GuidancePlan, GuidancePoint
from stereokit.layers import ConvNormAct, crop_to, init_convolutions
from stereokit.registry import AGGREGATIONS

__all__ = ["Hourglass", "VolumeHourglass"]


class Down(nn.Module):
    """Halve the volume, convolve, guide; or guide between the two convolutions."""

    def __init__(self, in_channels: int, out_channels: int, guidance: GuidancePoint, *, early: bool = False) -> None:
        super().__init__()
        self.early = early
        self.convs = nn.Sequential(
            ConvNormAct(in_channels, out_channels, dims=3, stride=2),
            ConvNormAct(out_channels, out_channels, dims=3),
        )
        self.guidance = guidance

    def forward(self, volume: Tensor, guides: Guides) -> Tensor:
        """(B, in_channels, D, H, W) to (B, out_channels, D/2, H/2, W/2)."""
        halve, conv = self.convs
        x = halve(volume)
        return conv(self.guidance(x, guides)) if self.early else self.guidance(conv(x), guides)


class Up(nn.Module):
    """Double the volume, merge the skip, convolve, guide; or guide ahead of the convolutions."""

    def __init__(self, in_channels: int, out_channels: int, guidance: GuidancePoint, *, early: bool = False) -> None:
        super().__init__()
        self.early = early
        self.up = ConvNormAct(in_channels, out_channels, 4, dims=3, stride=2, transposed=True)
        self.merge = ConvNormAct(2 * out_channels, out_channels, 1, dims=3)
        self.convs = nn.Sequential(
            ConvNormAct(out_channels, out_channels, dims=3), ConvNormAct(out_channels, out_channels, dims=3)
        )
        self.guidance = guidance

    def forward(self, volume: Tensor, skip: Tensor, guides: Guides) -> Tensor:
        """(B, in_channels, D, H, W) and a skip (B, out_channels, 2D, 2H, 2W) to the skip's shape."""
        merged = self.merge(torch.cat((crop_to(self.up(volume), skip), skip), dim=1))
        return self.convs(self.guidance(merged, guides)) if self.early else self.guidance(self.convs(merged), guides)


class VolumeHourglass(nn.Module):
    """Encoder-decoder of 3D convolutions with skips; image features guide it at every scale.

    Args:
        in_channels: of the cost volume.
        out_channels: of the volume that it gives.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; needed at `stride`, twice, four and eight times it for "full".
        guidance: makes a guidance block, such as `GCE`; None for none.
        guidance_at: "one" guides the stem's output only, "full" that of every stage.
        channels: of the stem and of the three scales below it, or of two.
        guide_early: ahead of the stem and between the convolutions of each scale, in place of behind them.
        stem: whether a convolution, with its guidance, comes first.

    Shape: volume (B, in_channels, D, H, W) and guides {stride: (B, G, H * stride0 / stride, ...)} to a volume
    (B, out_channels, D, H, W). D, H and W may be odd: what does not fit is cut.

    Raises:
        ConfigError: another number of scales.

    Source: CoEx, appendix "Detailed architecture", table "Cost aggregation module"; the early guidance is that of
    BANet's 3D form.

    >>> VolumeHourglass(in_channels=8, out_channels=8)(torch.rand(1, 8, 16, 32, 48), {}).shape
    torch.Size([1, 8, 16, 32, 48])
    """

    multiple = planes_multiple = 8

    def __init__(
        self,
        *,
        in_channels: int,
        out_channels: int,
        stride: int = 4,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "full",
        channels: Sequence[int] = (8, 16, 32, 48),
        guide_early: bool = False,
        stem: bool = True,
    ) -> None:
        super().__init__()
        if len(channels) not in (3, 4):
            raise ConfigError(f"channels={channels!r}: give those of the stem, and of two or three scales below it")
        self.in_channels = in_channels
        c0, c1, c2, *coarsest = channels
        self.multiple = self.planes_multiple = 2 ** (len(channels) - 1)
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)

        self.stem = ConvNormAct(in_channels, c0, dims=3) if stem else nn.Identity()
        self.guide_early = guide_early
        self.stem_guidance = (plan if stem else replace(plan, guidance=None)).first(in_channels if guide_early else c0)
        down, up = partial(Down, early=guide_early), partial(Up, early=guide_early)
        self.down1 = down(c0 if stem else in_channels, c1, plan.at(2, c1))
        self.down2 = down(c1, c2, plan.at(4, c2))
        self.down3: Down | None = None
        self.up3: Up | None = None
        if coarsest:
            (c3,) = coarsest
            self.down3 = down(c2, c3, plan.at(8, c3))
            self.up3 = up(c3, c2, plan.at(4, c2))
        self.up2 = up(c2, c1, plan.at(2, c1))
        self.up1 = nn.ConvTranspose3d(c1, out_channels, 4, stride=2, padding=1, bias=False)
        init_convolutions(self.up1)
        self.guide_channels = GuidancePlan.guides_read_by(self)

    def forward(self, volume: Tensor, guides: Guides) -> Tensor:
        """Volume and guides to a volume."""
        if self.guide_early:
            x = self.stem(self.stem_guidance(volume, guides))
        else:
            x = self.stem_guidance(self.stem(volume), guides)
        x1 = self.down1(x, guides)
        x2 = self.down2(x1, guides)
        if self.down3 is not None and self.up3 is not None:
            x3 = self.down3(x2, guides)
            x2 = self.up3(x3, x2, guides)
        x1 = self.up2(x2, x1, guides)
        return crop_to(self.up1(x1), volume)


@AGGREGATIONS.register("hourglass")
class Hourglass(VolumeHourglass):
    """Encoder-decoder of 3D convolutions with skips, to logits; image features guide it at every scale.

    Args:
        in_channels: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; needed at `stride`, twice, four and eight times it for "full".
        guidance: makes a guidance block, such as `GCE`; None for none.
        guidance_at: "one" guides the stem's output only, "full" that of every stage.
        channels: of the stem and of the three scales below it, or of two.
        guide_early: ahead of the stem and between the convolutions of each scale, in place of behind them.

    Shape: volume (B, in_channels, D, H, W) and guides {stride: (B, G, H * stride0 / stride, ...)} to one tensor
    (B, D, H, W) of logits, larger is better. D, H and W may be odd: what does not fit is cut.

    Raises:
        ConfigError: another number of scales.

    Source: CoEx, appendix "Detailed architecture", table "Cost aggregation module"; the early guidance is that of
    BANet's 3D form.

    >>> from stereokit import GCE
    >>> hourglass = Hourglass(in_channels=1, guidance=GCE, guide_channels={4: 96, 8: 64, 16: 192, 32: 160})
    >>> guides = {s: torch.rand(1, c, 128 // s, 192 // s) for s, c in hourglass.guide_channels.items()}
    >>> hourglass(torch.rand(1, 1, 24, 32, 48), guides)[-1].shape
    torch.Size([1, 24, 32, 48])
    """

    upscale = 1
    loss_weights = (1.0,)
    volume_heads = ("up1",)

    def __init__(
        self,
        *,
        in_channels: int,
        stride: int = 4,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "full",
        channels: Sequence[int] = (8, 16, 32, 48),
        guide_early: bool = False,
    ) -> None:
        super().__init__(
            in_channels=in_channels,
            out_channels=1,
            stride=stride,
            guide_channels=guide_channels,
            guidance=guidance,
            guidance_at=guidance_at,
            channels=channels,
            guide_early=guide_early,
        )

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:  # type: ignore[override]
        """Volume and guides to logits."""
        return (super().forward(volume, guides).squeeze(1),)
