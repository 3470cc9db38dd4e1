"""Heads whose logits spread to their neighbours in the volume: the 3D propagation of CSPN."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from stereokit.aggregation.wrapper import Wrapper
from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides, Head
from stereokit.layers import AffinityCentre, affinity_propagate, check_affinity, init_convolutions
from stereokit.registry import AGGREGATIONS

__all__ = ["WithPropagation"]


class PropagatedHead(nn.Module):
    """A head of logits, and a convolution of the same input to the affinity along which they spread."""

    def __init__(self, logits: nn.Module, *, steps: int, signed: bool, centre: AffinityCentre) -> None:
        super().__init__()
        self.logits = logits
        self.steps = steps
        self.signed = signed
        self.centre: AffinityCentre = centre
        layers: list[Any] = [m for m in logits.modules() if isinstance(m, nn.Conv3d | nn.ConvTranspose3d)]
        first, last = layers[0], layers[-1]
        # of the form of the last one, which alone may change the size
        self.affinity = type(last)(
            first.in_channels,
            27 if centre == "own" else 26,
            last.kernel_size,
            stride=last.stride,
            padding=last.padding,
            **({"output_padding": last.output_padding} if isinstance(last, nn.ConvTranspose3d) else {}),
        )
        init_convolutions(self.affinity)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, D, h, w) to (B, 1, D, h, w)."""
        affinity = self.affinity(x)
        return affinity_propagate(self.logits(x), affinity, steps=self.steps, signed=self.signed, centre=self.centre)


@AGGREGATIONS.register("with_propagation")
class WithPropagation(Wrapper):
    """Another aggregation, the logits of each head of which spread to their 26 neighbours by `affinity_propagate`.

    The affinity comes out of a 3x3x3 convolution of what the head sees.

    Args:
        base: an aggregation whose heads are 3D convolutions, by name or as ``{"name": ..., **arguments}``.
        in_channels, planes, stride, guide_channels, guidance, guidance_at: as the base takes them.
        steps: of the propagation; the authors' demonstrations have 24.
        signed: see `affinity_weights`.
        centre: see `affinity_propagate`.

    Shape: as of the base.

    Raises:
        ConfigError: a base that can't be built, or whose heads give no volume; no step, or another centre.

    Source: Cheng et al., "Learning depth with convolutional spatial propagation network", TPAMI 2019.

    >>> import torch
    >>> cspn = WithPropagation(base={"name": "stacked_hourglass", "channels": 8}, in_channels=64, planes=8).eval()
    >>> cspn(torch.rand(1, 64, 8, 16, 16), {})[-1].shape
    torch.Size([1, 8, 16, 16])
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
        steps: int = 12,
        signed: bool = True,
        centre: AffinityCentre = "input",
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
        check_affinity(3, steps, centre)
        self.replace_heads(
            "with_propagation", lambda head: PropagatedHead(head, steps=steps, signed=signed, centre=centre)
        )

    def forward(self, volume: Any, guides: Guides) -> tuple[Tensor | Head, ...]:
        """Volume and guides to logits."""
        return self.base(volume, guides)
