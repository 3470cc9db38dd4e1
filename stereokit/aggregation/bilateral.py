"""The cost aggregation of BANet: attention splits the volume between two branches, and joins what they give."""

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import Aggregation, Distribution, GuidanceFactory, GuidancePlacement, Guides
from stereokit.errors import ConfigError
from stereokit.layers import ConvNormAct, init_convolutions, named_activation
from stereokit.registry import AGGREGATIONS

__all__ = ["BilateralAggregation", "ScaleAwareAttention", "join", "split"]


def split(volume: Tensor, attention: Tensor) -> tuple[Tensor, Tensor]:
    r"""A volume in two parts that add up to it.

    .. math:: C_1 = A\, C, \qquad C_2 = (1 - A)\, C

    Args:
        volume: C, (B, C, D, H, W).
        attention: A, (B, 1, H, W), in [0, 1].

    Returns:
        Two of the volume's shape.

    Source: Xu et al., "BANet: bilateral aggregation network for mobile stereo matching", ICCV 2025.

    >>> [part.item() for part in split(torch.full((1, 1, 1, 1, 1), 8.0), torch.full((1, 1, 1, 1), 0.25))]
    [2.0, 6.0]
    """
    first = volume * attention.unsqueeze(2).to(volume.dtype)
    return first, volume - first


def join(first: Tensor, second: Tensor, attention: Tensor) -> Tensor:
    r"""What two branches give, weighed as their volumes were.

    .. math:: L = A\, L_1 + (1 - A)\, L_2

    Args:
        first: (B, D, H, W).
        second: likewise.
        attention: A, (B, 1, h, w), in [0, 1]; interpolated where it is coarser.

    Source: Xu et al., "BANet", ICCV 2025.

    >>> join(torch.full((1, 1, 1, 1), 8.0), torch.full((1, 1, 1, 1), 4.0), torch.full((1, 1, 1, 1), 0.25)).item()
    5.0
    """
    if attention.shape[-2:] != first.shape[-2:]:
        attention = F.interpolate(attention, first.shape[-2:], mode="bilinear", align_corners=False)
    return second + attention.to(first.dtype) * (first - second)


class ScaleAwareAttention(nn.Module):
    """Guides of three scales to one map in [0, 1]: where there is detail, and where it is smooth.

    Args:
        guide_channels: of the guides, by stride.
        stride: of the map; guides at it, at twice and at four times it are read.
        channels: of all layers.
        activation: "leaky_relu", "relu6", ..., see `named_activation`.

    Shape: guides by stride to (B, 1, H, W), of the size of the finest.

    Raises:
        ConfigError: a guide is missing, or an unknown activation.

    Source: Xu et al., "BANet: bilateral aggregation network for mobile stereo matching", ICCV 2025.

    >>> attention = ScaleAwareAttention(guide_channels={4: 8, 8: 6, 16: 4}, channels=4)
    >>> attention({s: torch.rand(1, c, 64 // s, 96 // s) for s, c in attention.guide_channels.items()}).shape
    torch.Size([1, 1, 16, 24])
    """

    def __init__(
        self, *, guide_channels: Mapping[int, int], stride: int = 4, channels: int = 32, activation: str = "leaky_relu"
    ) -> None:
        super().__init__()
        strides = (stride, 2 * stride, 4 * stride)
        missing = [str(s) for s in strides if s not in guide_channels]
        if missing:
            raise ConfigError(
                f"attention at stride {stride} wants guides at stride {', '.join(missing)} too; there are guides at "
                f"{', '.join(map(str, guide_channels)) or 'none'}"
            )
        self.guide_channels = {s: guide_channels[s] for s in strides}
        conv = partial(ConvNormAct, activation=named_activation(activation))
        self.embed = nn.ModuleList(conv(guide_channels[s], channels) for s in strides)
        self.merge = conv(3 * channels, channels)
        self.head = nn.Sequential(
            nn.Conv2d(channels, channels, 1), nn.Conv2d(channels, 1, 5, padding=2, bias=False), nn.Sigmoid()
        )
        init_convolutions(self.head)

    def forward(self, guides: Guides) -> Tensor:
        """Guides to the map."""
        maps = [embed(guides[stride]) for stride, embed in zip(self.guide_channels, self.embed, strict=True)]
        size = maps[0].shape[-2:]
        coarse = (F.interpolate(x, size, mode="bilinear", align_corners=False) for x in maps[1:])
        attention: Tensor = self.head(self.merge(torch.cat((maps[0], *coarse), dim=1)))
        return attention


@AGGREGATIONS.register("bilateral")
class BilateralAggregation(nn.Module):
    """Two branches, each with its own weights: one for what an attention map lets through, one for the rest.

    Both are of one kind, which may be any aggregation, and share the guidance that is chosen.

    Args:
        in_channels: of the cost volume.
        planes: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; needed at `stride`, twice and four times it.
        guidance: makes a guidance block of the branches; None for none.
        guidance_at: "one" or "full", likewise.
        branch: name of an aggregation, or ``{"name": ..., **arguments}``.
        channels: a 3x3 or 3x3x3 convolution makes so many of the volume before it is split; None splits it as it is.
        dims: with `channels`: 3 for those of a volume, 2 for maps which stand in place of the planes: then a 1x1
            convolution behind each branch gives `planes` of them again.
        attention_channels: of the attention's layers.
        activation: of that convolution and of the attention, see `named_activation`.

    Shape: volume (B, in_channels, planes, H, W) and guides by stride to what the branches give.

    Raises:
        ConfigError: a guide is missing, the branch is unknown or does not fit, or `dims` without `channels`.

    Source: Xu et al., "BANet: bilateral aggregation network for mobile stereo matching", ICCV 2025.

    >>> aggregation = BilateralAggregation(
    ...     in_channels=1, planes=16, guide_channels={4: 8, 8: 6, 16: 4}, branch={"name": "plain", "channels": 4}
    ... )
    >>> guides = {s: torch.rand(1, c, 64 // s, 96 // s) for s, c in aggregation.guide_channels.items()}
    >>> aggregation(torch.rand(1, 1, 16, 16, 24), guides)[-1].shape
    torch.Size([1, 16, 16, 24])
    """

    multiple = planes_multiple = upscale = planes_upscale = 1
    loss_weights: tuple[float, ...] = (1.0,)

    def __init__(
        self,
        *,
        in_channels: int,
        planes: int,
        stride: int = 4,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "full",
        branch: str | Mapping[str, Any] = "hourglass",
        channels: int | None = None,
        dims: Literal[2, 3] = 3,
        attention_channels: int = 32,
        activation: str = "leaky_relu",
    ) -> None:
        super().__init__()
        if dims not in (2, 3) or (dims == 2 and channels is None):
            raise ConfigError(f"dims={dims!r} is 3, or with a number of channels 2; got channels={channels!r}")
        self.in_channels = in_channels
        self.in_maps = dims == 2
        self.attention = ScaleAwareAttention(
            guide_channels=guide_channels or {}, stride=stride, channels=attention_channels, activation=activation
        )
        act = named_activation(activation)
        self.embedding: nn.Module = nn.Identity()
        width, levels = in_channels, planes
        if channels is not None and self.in_maps:
            self.embedding = ConvNormAct(in_channels * planes, channels, activation=act)
            width, levels = 1, channels
        elif channels is not None:
            self.embedding = ConvNormAct(in_channels, channels, dims=3, activation=act)
            width = channels
        name, arguments = AGGREGATIONS.named(branch, "a branch is the name of an aggregation")
        offered = {
            "in_channels": width,
            "planes": levels,
            "stride": stride,
            "guide_channels": guide_channels,
            "guidance": guidance,
            "guidance_at": guidance_at,
        }
        decided = [key for key in arguments if key in offered]
        if decided:
            raise ConfigError(f"{', '.join(decided)} of the branch {name!r} follows from the rest; leave it out")
        branches: list[Aggregation] = [AGGREGATIONS.build(name, arguments, offered) for _ in range(2)]
        self.branches = nn.ModuleList(branches)  # type: ignore[arg-type]
        of = branches[0]
        if self.in_maps and (of.upscale != 1 or levels % of.planes_multiple):
            raise ConfigError(
                f"the branch {name!r} takes planes in multiples of {of.planes_multiple} to a scale {of.upscale} times "
                f"finer; it can't work on {levels} channels in place of planes: use dims=3"
            )
        self.heads = nn.ModuleList(nn.Conv2d(levels, planes, 1) if self.in_maps else nn.Identity() for _ in range(2))
        init_convolutions(self.heads)
        self.multiple = of.multiple
        self.planes_multiple = 1 if self.in_maps else of.planes_multiple
        self.upscale = of.upscale
        self.planes_upscale = int(getattr(of, "planes_upscale", of.upscale))
        self.loss_weights = of.loss_weights
        self.least_size = int(getattr(of, "least_size", 0))
        self.guide_channels = {**self.attention.guide_channels, **of.guide_channels}

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor | Distribution, ...]:
        """Volume and guides to logits."""
        attention = self.attention(guides)
        x = self.embedding(volume.flatten(1, 2)).unsqueeze(1) if self.in_maps else self.embedding(volume)
        first, second = (branch(part, guides) for branch, part in zip(self.branches, split(x, attention), strict=True))
        return tuple(self._joined(one, other, attention) for one, other in zip(first, second, strict=True))

    def _joined(self, one: Tensor | Distribution, other: Tensor | Distribution, attention: Tensor) -> Any:
        """Heads of both branches to one."""
        if isinstance(one, Distribution) and isinstance(other, Distribution):
            logits = self._joined(one.logits, other.logits, attention)
            offsets = None
            if one.offsets is not None and other.offsets is not None:
                offsets = join(one.offsets, other.offsets, attention)
            return one._replace(logits=logits, offsets=offsets)
        return join(self.heads[0](one), self.heads[1](other), attention)
