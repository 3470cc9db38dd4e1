"""The cost aggregation of LightStereo: an hourglass of 2D convolutions whose channels are the disparities."""

from collections.abc import Mapping, Sequence

from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.errors import ConfigError
from stereokit.guidance.point import GuidancePlan, GuidancePoint
from stereokit.layers import ConvNormAct, InvertedResidual, crop_to, init_convolutions
from stereokit.registry import AGGREGATIONS

__all__ = ["InvertedResidualHourglass"]


class Down(nn.Module):
    """Inverted residuals at one scale, and guidance."""

    def __init__(
        self, in_channels: int, channels: int, blocks: int, *, stride: int, expansion: int, guidance: GuidancePoint
    ) -> None:
        super().__init__()
        first = InvertedResidual(in_channels, channels, stride=stride, expansion=expansion)
        more = (InvertedResidual(channels, channels, expansion=expansion) for _ in range(blocks - 1))
        self.blocks = nn.Sequential(first, *more)
        self.guidance = guidance

    def forward(self, x: Tensor, guides: Guides) -> Tensor:
        """(B, in_channels, H, W) to (B, channels, H / stride, W / stride)."""
        return self.guidance.on_maps(self.blocks(x), guides)


class Up(nn.Module):
    """Double the maps and add the skip."""

    def __init__(self, in_channels: int, channels: int, *, expansion: int) -> None:
        super().__init__()
        self.up = ConvNormAct(in_channels, channels, stride=2, transposed=True, activation=None)
        self.skip = InvertedResidual(channels, channels, expansion=expansion)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """(B, in_channels, h, w) and a skip (B, channels, 2h, 2w) to the skip's shape, nowhere negative."""
        return F.relu(crop_to(self.up(x), skip) + self.skip(skip))


@AGGREGATIONS.register("inverted_residual")
class InvertedResidualHourglass(nn.Module):
    """Hourglass of inverted residual blocks in 2D: the planes of disparity are the channels.

    It has no 3D convolution. Where the volume has several channels, a 1x1x1 convolution first makes one of them.

    Args:
        in_channels: of the cost volume.
        planes: of the cost volume: the width of the finest scale; twice and four times that below.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; needed at `stride`, twice and four times it for "full".
        guidance: makes a guidance block, such as `MSCA`; None for none. It sees the maps as volumes of depth 1.
        guidance_at: "one" guides the finest scale of the encoder only, "full" all three.
        blocks: inverted residuals at each scale of the encoder.
        expansion: of these, see `InvertedResidual`.

    Shape: volume (B, in_channels, planes, H, W) and guides {stride: (B, G, H * stride0 / stride, ...)} to one tensor
    (B, planes, H, W) of logits, larger is better, none below 0. H and W may be odd: what does not fit is cut.

    Raises:
        ConfigError: a scale without a block.

    Source: Guo et al., "LightStereo: channel boost is all you need for efficient 2D cost aggregation", ICRA 2025.

    >>> import torch
    >>> from stereokit import MSCA
    >>> hourglass = InvertedResidualHourglass(
    ...     in_channels=1, planes=12, guidance=MSCA, guide_channels={4: 24, 8: 32, 16: 96}
    ... )
    >>> guides = {s: torch.rand(1, c, 64 // s, 96 // s) for s, c in hourglass.guide_channels.items()}
    >>> hourglass(torch.rand(1, 1, 12, 16, 24), guides)[-1].shape
    torch.Size([1, 12, 16, 24])
    """

    multiple = 4
    planes_multiple = 1
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
        guidance_at: GuidancePlacement = "full",
        blocks: Sequence[int] = (1, 2, 4),
        expansion: int = 4,
    ) -> None:
        super().__init__()
        if len(blocks) != 3 or min(blocks) < 1:
            raise ConfigError(
                f"blocks={blocks!r}: give one block or more for each of the three scales, such as 1, 2, 4"
            )
        self.in_channels = in_channels
        p, (n1, n2, n3) = planes, blocks
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)

        self.join = nn.Conv3d(in_channels, 1, 1) if in_channels > 1 else nn.Identity()
        init_convolutions(self.join)
        self.down1 = Down(p, p, n1, stride=1, expansion=expansion, guidance=plan.first(p))
        self.down2 = Down(p, 2 * p, n2, stride=2, expansion=expansion, guidance=plan.at(2, 2 * p))
        self.down3 = Down(2 * p, 4 * p, n3, stride=2, expansion=expansion, guidance=plan.at(4, 4 * p))
        self.up2 = Up(4 * p, 2 * p, expansion=expansion)
        self.up1 = Up(2 * p, p, expansion=expansion)
        self.guide_channels = GuidancePlan.guides_read_by(self)

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """Volume and guides to logits."""
        x1 = self.down1(self.join(volume).squeeze(1), guides)
        x2 = self.down2(x1, guides)
        x3 = self.down3(x2, guides)
        return (self.up1(self.up2(x3, x2), x1),)
