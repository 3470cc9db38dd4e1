"""Heads that say how sure they are: the confidence networks of AcfNet."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from stereokit.aggregation.wrapper import Wrapper
from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides, Head
from stereokit.layers import ConvNormAct, relu
from stereokit.registry import AGGREGATIONS

__all__ = ["ConfidenceNetwork", "WithConfidence"]


class ConfidenceNetwork(nn.Module):
    r"""How sure a distribution is, from its logits as channels of an image.

    .. math:: f = \sigma(W_2\, \mathrm{ReLU}(\mathrm{BN}(W_1 * c)))

    with 3x3 convolutions for the first and a 1x1 one for the second. What it gives lacks the sigmoid.

    Args:
        planes: of the logits.
        channels: between the two.

    Source: Zhang et al., "Adaptive unimodal cost volume filtering for deep stereo matching", AAAI 2020, "confidence
    estimation network".

    >>> import torch
    >>> ConfidenceNetwork(12)(torch.rand(2, 12, 4, 6)).shape
    torch.Size([2, 4, 6])
    """

    def __init__(self, planes: int, channels: int = 64) -> None:
        super().__init__()
        self.hidden = ConvNormAct(planes, channels, activation=relu)
        self.last = nn.Conv2d(channels, 1, 1, bias=False)

    def forward(self, logits: Tensor) -> Tensor:
        """(B, D, H, W) to (B, H, W)."""
        certainty: Tensor = self.last(self.hidden(logits))
        return certainty.squeeze(1)


@AGGREGATIONS.register("with_confidence")
class WithConfidence(Wrapper):
    """Another aggregation, each head of which says how sure it is, by a `ConfidenceNetwork` of its own.

    The network gives it as the confidence of its estimate; the loss "stereo_focal" learns it.

    Args:
        base: an aggregation, by name or as ``{"name": ..., **arguments}``.
        in_channels, planes, stride, guide_channels, guidance, guidance_at: as the base takes them.
        channels: of the confidence networks.

    Shape: as of the base, with the certainty (B, h, w) of each head.

    Raises:
        ConfigError: a base that can't be built.

    Source: Zhang et al., "Adaptive unimodal cost volume filtering for deep stereo matching", AAAI 2020.

    >>> import torch
    >>> acf = WithConfidence(base={"name": "stacked_hourglass", "channels": 8}, in_channels=64, planes=8).eval()
    >>> acf(torch.rand(1, 64, 8, 16, 16), {})[-1].certainty.shape
    torch.Size([1, 16, 16])
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
        channels: int = 64,
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
        levels = planes * self.planes_upscale
        self.confidence = nn.ModuleList(ConfidenceNetwork(levels, channels) for _ in self.loss_weights)

    def forward(self, volume: Any, guides: Guides) -> tuple[Head, ...]:
        """Volume and guides to logits and certainty."""
        heads = self.heads_with(self.confidence, volume, guides)
        return tuple(head._replace(certainty=network(head.logits)) for head, network in heads)
