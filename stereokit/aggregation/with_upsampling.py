"""Heads whose logits are made finer by a convolution of their own."""

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.aggregation.wrapper import Wrapper
from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides, Head
from stereokit.errors import ConfigError
from stereokit.layers import bilinear_upsample
from stereokit.registry import AGGREGATIONS

__all__ = ["LearnedUpsampling", "WithUpsampling", "learned_upsample"]


def learned_upsample(logits: Tensor, weight: Tensor) -> Tensor:
    r"""The transposed convolution of one channel with kernel 2s, stride s and padding s / 2, as a plain one.

    .. math:: y(s m + r) = \sum_{t=-1}^{1} w(r + s / 2 - s t)\, x(m + t), \quad 0 \le r < s

    in each of the three dimensions; w is 0 outside. A convolution of 3 x 3 x 3 gives the s x s x s outputs r of each
    input m as channels, which takes less than a third of the time of the transposed one on a CPU.

    Args:
        logits: x, (B, D, h, w).
        weight: w, (1, 1, 2s, 2s, 2s), s even.

    Returns:
        (B, D * s, h * s, w * s).

    Source: Zhang et al., "Adaptive unimodal cost volume filtering for deep stereo matching", AAAI 2020, in the form of
    the authors' code.

    >>> learned_upsample(torch.rand(1, 6, 2, 3), torch.rand(1, 1, 8, 8, 8)).shape
    torch.Size([1, 24, 8, 12])
    """
    side = weight.shape[-1]
    scale = side // 2
    outputs, taps = (torch.arange(n, device=weight.device) for n in (scale, 3))
    place = outputs.unsqueeze(1) + scale // 2 - scale * (taps - 1)
    # (output, tap, place in the kernel): 1 where a tap of an output is that place
    chosen = (place.unsqueeze(2) == torch.arange(side, device=weight.device)).to(weight.dtype)
    kernels = torch.einsum("ati,bsj,cuk,ijk->abctsu", chosen, chosen, chosen, weight[0, 0])
    fine = F.conv3d(logits.unsqueeze(1), kernels.reshape(scale**3, 1, 3, 3, 3), padding=1)
    batch, planes, height, width = logits.shape
    fine = fine.reshape(batch, scale, scale, scale, planes, height, width).permute(0, 4, 1, 5, 2, 6, 3)
    return fine.reshape(batch, planes * scale, height * scale, width * scale)


class LearnedUpsampling(nn.Module):
    """`learned_upsample` with its weights, drawn as PyTorch's convolutions are.

    Args:
        scale: of all three dimensions, even.

    >>> LearnedUpsampling(2)(torch.rand(1, 6, 2, 3)).shape
    torch.Size([1, 12, 4, 6])
    """

    def __init__(self, scale: int = 4) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(1, 1, *3 * (2 * scale,)))
        nn.init.kaiming_uniform_(self.weight, a=math.sqrt(5))

    def forward(self, logits: Tensor) -> Tensor:
        """(B, D, h, w) to (B, D * scale, h * scale, w * scale)."""
        return learned_upsample(logits, self.weight)


@AGGREGATIONS.register("with_upsampling")
class WithUpsampling(Wrapper):
    """Another aggregation, the logits of each head of which are enlarged by `learned_upsample`.

    Offsets, where there are any, are interpolated.

    Args:
        base: an aggregation, by name or as ``{"name": ..., **arguments}``.
        in_channels, planes, stride, guide_channels, guidance, guidance_at: as the base takes them.
        scale: of all three dimensions, even.

    Shape: as of the base, all three dimensions of the logits `scale` times as large.

    Raises:
        ConfigError: a base that can't be built, or a scale that is not even.

    Source: Zhang et al., "Adaptive unimodal cost volume filtering for deep stereo matching", AAAI 2020, in the form of
    the authors' code.

    >>> acf = WithUpsampling(base={"name": "stacked_hourglass", "channels": 8}, in_channels=64, planes=8).eval()
    >>> acf(torch.rand(1, 64, 8, 16, 16), {})[-1].logits.shape
    torch.Size([1, 32, 64, 64])
    """

    def __init__(
        self,
        *,
        base: str | Mapping[str, Any],
        in_channels: int,
        planes: int,
        stride: int = 4,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement | None = None,
        scale: int = 4,
    ) -> None:
        super().__init__(
            base=base,
            in_channels=in_channels,
            planes=planes,
            stride=stride,
            guide_channels=guide_channels,
            guidance=guidance,
            guidance_at=guidance_at,
        )
        if isinstance(scale, bool) or not isinstance(scale, int) or scale < 2 or scale % 2:
            raise ConfigError(f"scale={scale!r} of 'with_upsampling' has to be an even number from 2 up")
        self.scale = scale
        self.upscale = self.base.upscale * scale
        self.planes_upscale *= scale
        self.enlarge = nn.ModuleList(LearnedUpsampling(scale) for _ in self.loss_weights)

    def forward(self, volume: Any, guides: Guides) -> tuple[Head, ...]:
        """Volume and guides to finer logits."""
        return tuple(self._enlarged(head, enlarge) for head, enlarge in self.heads_with(self.enlarge, volume, guides))

    def _enlarged(self, head: Head, enlarge: nn.Module) -> Head:
        offsets, certainty = head.offsets, head.certainty
        if offsets is not None:
            offsets = F.interpolate(offsets.unsqueeze(1), scale_factor=float(self.scale), mode="trilinear").squeeze(1)
        if certainty is not None:
            certainty = bilinear_upsample(certainty, self.scale)
        return Head(enlarge(head.logits), offsets, certainty)
