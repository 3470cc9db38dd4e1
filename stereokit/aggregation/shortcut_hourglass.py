"""The cost aggregation of PDS-Net: an hourglass that takes in left features, and ends at full size."""

from collections.abc import Mapping
from functools import partial

from torch import Tensor, nn

from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.errors import ConfigError
from stereokit.guidance.point import GuidancePlan
from stereokit.layers import conv_act_norm, crop_to, init_convolutions
from stereokit.registry import AGGREGATIONS

__all__ = ["ShortcutHourglass"]

HALVINGS = 4

conv = partial(conv_act_norm, dims=3)


class Contraction(nn.Module):
    """Halves the volume and doubles its width."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.down = conv(channels, 2 * channels, stride=2)
        self.smooth = conv(2 * channels, 2 * channels)

    def forward(self, shortcut: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
        """What goes down beside the volume, and the volume, to both at half their size."""
        shortcut = self.down(shortcut + x)
        return shortcut, self.smooth(shortcut)


class Expansion(nn.Module):
    """Doubles the volume, halves its width, and adds the skip."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.up = conv(channels, channels // 2, 4, stride=2, transposed=True)
        self.smooth = conv(channels // 2, channels // 2)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """(B, C, d, h, w) and a skip (B, C / 2, 2d, 2h, 2w) to the skip's shape."""
        return self.smooth(crop_to(self.up(x), skip) + skip)


@AGGREGATIONS.register("shortcut_hourglass")
class ShortcutHourglass(nn.Module):
    """Hourglass of 3D convolutions with instance norms; left features enter beside the volume, alike at each disparity.

    The logits are four times finer in height and width, and twice in the planes. Guidance acts on the smoothed volume;
    "full" adds a place behind each contraction and expansion.

    Args:
        in_channels: of the cost volume.
        planes: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; the one at `stride` is needed, for "full" those down to 16 times it.
        guidance: makes a guidance block, such as `GCE`; None for none.
        guidance_at: "one" or "full".
        channels: at the finest scale.

    Shape: volume (B, in_channels, planes, H, W) and guides by stride to one tensor (B, 2 * planes, 4H, 4W) of logits,
    larger is better.

    Raises:
        ConfigError: there is no guide at this stride.

    Source: Tulyakov et al., "Practical Deep Stereo (PDS): toward applications-friendly deep stereo matching",
    NeurIPS 2018, "Regularization".

    >>> import torch
    >>> hourglass = ShortcutHourglass(in_channels=8, planes=16, guide_channels={4: 64})
    >>> hourglass(torch.rand(1, 8, 16, 16, 32), {4: torch.rand(1, 64, 16, 32)})[-1].shape
    torch.Size([1, 32, 64, 128])
    """

    multiple = planes_multiple = 2**HALVINGS
    upscale = 4
    planes_upscale = 2
    loss_weights = (1.0,)
    volume_heads = ("to_full_size",)

    def __init__(
        self,
        *,
        in_channels: int,
        planes: int,
        stride: int = 4,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "one",
        channels: int = 8,
    ) -> None:
        super().__init__()
        guides = guide_channels or {}
        if stride not in guides:
            raise ConfigError(
                f"the shortcut at stride {stride} wants a guide of that stride; there are guides at "
                f"{', '.join(map(str, guides)) or 'none'}"
            )
        self.in_channels = in_channels
        self.stride = stride
        # an instance norm fails on a single voxel
        self.least_size = stride * self.multiple + 1 if planes == self.planes_multiple else 0
        plan = GuidancePlan(guidance, guidance_at, stride, guides)
        widths = [channels << i for i in range(HALVINGS + 1)]
        self.shortcut = conv_act_norm(guides[stride], channels)
        self.smooth = conv(in_channels, channels)
        self.guidance = plan.first(channels)
        self.down = nn.ModuleList(Contraction(c) for c in widths[:-1])
        self.down_guidance = nn.ModuleList(plan.at(2 << i, c) for i, c in enumerate(widths[1:]))
        self.up = nn.ModuleList(Expansion(c) for c in reversed(widths[1:]))
        self.up_guidance = nn.ModuleList(plan.at(1 << i, widths[i]) for i in reversed(range(HALVINGS)))
        self.to_half_size = conv(channels, channels // 2, 4, stride=2, transposed=True)
        self.to_full_size = nn.ConvTranspose3d(channels // 2, 1, (3, 4, 4), stride=(1, 2, 2), padding=1)
        init_convolutions(self.to_full_size)
        self.guide_channels = {stride: guides[stride], **GuidancePlan.guides_read_by(self)}

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """Volume and guides to logits."""
        x = self.guidance(self.smooth(volume), guides)
        shortcut = self.shortcut(guides[self.stride]).unsqueeze(2)
        skips = []
        for down, guidance in zip(self.down, self.down_guidance, strict=True):
            skips.append(x)
            shortcut, x = down(shortcut, x)
            x = guidance(x, guides)
        for up, guidance, skip in zip(self.up, self.up_guidance, reversed(skips), strict=True):
            x = guidance(up(x, skip), guides)
        return (self.to_full_size(self.to_half_size(x)).squeeze(1),)
