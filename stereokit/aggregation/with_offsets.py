"""Heads that say where in its bin a disparity lies: the continuous distributions of CDN."""

from collections.abc import Mapping
from copy import deepcopy
from typing import Any, cast

import torch
from torch import Tensor, nn

from stereokit.aggregation.wrapper import Wrapper
from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides, Head
from stereokit.layers import init_convolutions
from stereokit.registry import AGGREGATIONS

__all__ = ["WithOffsets"]


class TwinHead(nn.Module):
    """A head of logits, and one of the same form for the offsets."""

    def __init__(self, logits: nn.Module) -> None:
        super().__init__()
        self.logits = logits
        self.offsets = deepcopy(logits)
        init_convolutions(self.offsets)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, D, h, w) to (2B, 1, D, h, w), the logits first: whatever the base does to logits, it does to both."""
        return torch.cat((self.logits(x), self.offsets(x)))


@AGGREGATIONS.register("with_offsets")
class WithOffsets(Wrapper):
    r"""Another aggregation whose heads give offsets beside the logits, each from a twin of the head.

    A plane then no longer stands for its lower end, but for the disparity that its offset o says:

    .. math:: x_j = (j + b(o_j))\, s, \qquad b(o) \in [0, 1]

    with the distance s between planes and `bin_shift` for b. Where a head adds to the one before, its offsets do too.

    Args:
        base: an aggregation whose heads are 3D convolutions, by name or as ``{"name": ..., **arguments}``.
        in_channels, planes, stride, guide_channels, guidance, guidance_at: as the base takes them.

    Shape: as of the base, with the offsets in the shape of the logits.

    Raises:
        ConfigError: a base that can't be built, or whose heads give no volume.

    Source: Garg et al., "Wasserstein distances for stereo disparity estimation", NeurIPS 2020.

    >>> cdn = WithOffsets(base={"name": "stacked_hourglass", "channels": 8}, in_channels=64, planes=8)
    >>> [head.offsets.shape for head in cdn(torch.rand(2, 64, 8, 16, 16), {})]
    [torch.Size([2, 8, 16, 16]), torch.Size([2, 8, 16, 16]), torch.Size([2, 8, 16, 16])]
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
        self.replace_heads("with_offsets", TwinHead)

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Head, ...]:
        """Volume and guides to logits and offsets."""
        heads = cast(tuple[Tensor, ...], self.base(volume, guides))
        return tuple(Head(*both.chunk(2)) for both in heads)
