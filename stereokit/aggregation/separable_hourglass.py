"""The cost aggregation of MobileStereoNet: GwcNet's, of inverted residuals in 3D or 2D."""

from collections.abc import Mapping
from functools import partial
from typing import Literal

from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.aggregation.logits_head import logits_head
from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.errors import ConfigError
from stereokit.guidance.point import GuidancePlan, GuidancePoint
from stereokit.layers import ConvNormAct, InvertedResidual, crop_to, init_convolutions, relu
from stereokit.registry import AGGREGATIONS

__all__ = ["SeparableHourglass"]

Dims = Literal[2, 3]


class Hourglass(nn.Module):
    """Two halvings and back; each doubles the width, and inverted residuals skip them."""

    def __init__(self, channels: int, plan: GuidancePlan, *, dims: Dims, residual: bool) -> None:
        super().__init__()
        c1, c2, c4 = channels, 2 * channels, 4 * channels
        block = partial(InvertedResidual, expansion=2, dims=dims, residual=residual)
        up = partial(ConvNormAct, dims=dims, stride=2, transposed=True, activation=None)
        self.conv1, self.conv2 = block(c1, c2, stride=2), block(c2, c2)
        self.conv3, self.conv4 = block(c2, c4, stride=2), block(c4, c4)
        self.conv5, self.conv6 = up(c4, c2), up(c2, c1)
        self.skip1, self.skip2 = block(c1, c1), block(c2, c2)
        self.down_guidance, self.bottom_guidance, self.up_guidance = plan.at(2, c2), plan.at(4, c4), plan.at(2, c2)

    def forward(self, x: Tensor, guides: Guides) -> Tensor:
        """Volume or maps, and guides, to the same."""
        half = guided(self.down_guidance, self.conv2(self.conv1(x)), guides)
        bottom = guided(self.bottom_guidance, self.conv4(self.conv3(half)), guides)
        up = F.relu(crop_to(self.conv5(bottom), half) + self.skip2(half))
        up = guided(self.up_guidance, up, guides)
        return F.relu(crop_to(self.conv6(up), x) + self.skip1(x))


@AGGREGATIONS.register("separable_hourglass")
class SeparableHourglass(nn.Module):
    """Two pairs of inverted residuals, three hourglasses in a row and four heads, the first three for training.

    In 2D, the planes of disparity are the channels; where the volume has several channels, a 1x1x1 convolution first
    makes one of them. Guidance at "one" place acts after the first pair; "full" adds the three places inside each
    hourglass.

    Args:
        in_channels: of the cost volume.
        planes: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; needed at `stride`, twice and four times it for "full".
        guidance: makes a guidance block, such as `GCE`; None for none. In 2D it sees the maps as volumes of depth 1.
        guidance_at: "one" or "full".
        dims: 3 for 3D convolutions, 2 for 2D ones.
        channels: of the volumes at the finest scale, in 3D.
        residual: whether inverted residuals add their input; None for in 2D alone, as the published networks have it.

    Shape: volume (B, in_channels, planes, H, W) and guides by stride to four tensors (B, planes, H, W) of logits,
    larger is better, the best one last; in eval mode to that one alone.

    Raises:
        ConfigError: another number of dimensions.

    Source: Shamsafar et al., "MobileStereoNet: towards lightweight deep networks for stereo matching", WACV 2022,
    section 3.

    >>> import torch
    >>> flat = SeparableHourglass(in_channels=1, planes=12, dims=2).eval()
    >>> flat(torch.rand(1, 1, 12, 16, 24), {})[-1].shape
    torch.Size([1, 12, 16, 24])
    """

    multiple = 4
    planes_multiple = 4
    upscale = 1
    loss_weights = (0.5, 0.5, 0.7, 1.0)

    def __init__(
        self,
        *,
        in_channels: int,
        planes: int,
        stride: int = 4,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "one",
        dims: Dims = 3,
        channels: int = 32,
        residual: bool | None = None,
    ) -> None:
        super().__init__()
        if dims not in (2, 3):
            raise ConfigError(f"dims={dims!r}: use 2 or 3")
        self.in_channels = in_channels
        self.dims = dims
        adds = dims == 2 if residual is None else residual
        c = planes if dims == 2 else channels
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)
        block = partial(InvertedResidual, expansion=3, dims=dims, residual=adds)
        # as published: between the blocks of a pair in 2D alone
        between = [relu()] if dims == 2 else []

        self.join = nn.Conv3d(in_channels, 1, 1) if dims == 2 and in_channels > 1 else nn.Identity()
        init_convolutions(self.join)
        first = planes if dims == 2 else in_channels
        self.pair0 = nn.Sequential(block(first, c), *between, block(c, c), *between)
        self.guidance = plan.first(c)
        self.pair1 = nn.Sequential(block(c, c), *between, block(c, c))
        self.hourglass1, self.hourglass2, self.hourglass3 = (
            Hourglass(c, plan, dims=dims, residual=adds) for _ in range(3)
        )
        head = planes_head if dims == 2 else logits_head
        self.head0, self.head1, self.head2, self.head3 = (head(c) for _ in range(4))
        self.volume_heads = ("head0", "head1", "head2", "head3") if dims == 3 else ()
        self.guide_channels = GuidancePlan.guides_read_by(self)

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """Volume and guides to logits."""
        x = self.join(volume).squeeze(1) if self.dims == 2 else volume
        x = guided(self.guidance, self.pair0(x), guides)
        x0 = self.pair1(x) + x
        x1 = self.hourglass1(x0, guides)
        x2 = self.hourglass2(x1, guides)
        x3 = self.hourglass3(x2, guides)
        if not self.training:
            return (self._planes(self.head3(x3)),)
        heads = (self.head0(x0), self.head1(x1), self.head2(x2), self.head3(x3))
        return tuple(self._planes(logits) for logits in heads)

    def _planes(self, logits: Tensor) -> Tensor:
        return logits if self.dims == 2 else logits.squeeze(1)


def planes_head(planes: int) -> nn.Sequential:
    """Two 3x3 convolutions: (B, planes, H, W) to logits of that shape."""
    last = nn.Conv2d(planes, planes, 3, padding=1, bias=False)
    init_convolutions(last)
    return nn.Sequential(ConvNormAct(planes, planes, activation=relu), last)


def guided(point: GuidancePoint, x: Tensor, guides: Guides) -> Tensor:
    """A volume, or maps, guided."""
    return point.on_maps(x, guides) if x.dim() == 4 else point(x, guides)
