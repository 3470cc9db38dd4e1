"""What each slot takes and gives.

A network is one choice per slot::

    images ─▶ backbone ─▶ cost ─▶ aggregation ─▶ regression ─▶ upsampler ─▶ disparity
                  └────── guides ─────┴──────────────────────────┘

The protocols below are all that a component owes its neighbours; a plain `torch.nn.Module` with these attributes
fits. Strides are in pixels of the padded input: a map of stride 4 has a quarter of its height and width.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

from torch import Tensor, nn

from stereokit.errors import ConfigError

__all__ = [
    "Aggregation",
    "Backbone",
    "Cost",
    "FeatureInfo",
    "Features",
    "GuidanceFactory",
    "GuidancePlacement",
    "Guides",
    "Regression",
    "Upsampler",
    "check_contracts",
    "check_interface",
]

Guides = Mapping[int, Tensor]
"""Feature maps of the left image by stride, each (B, C, H / stride, W / stride)."""

GuidancePlacement = Literal["one", "full"]
"""Guidance at the finest scale of the aggregation only, or at every scale."""


class Features(NamedTuple):
    """What a backbone returns for a batch of images."""

    matching: Tensor
    """(B, C, h, w): the map that the cost compares."""
    guides: dict[int, Tensor]
    """Maps that guide aggregation and upsampling, by stride."""


@dataclass(frozen=True)
class FeatureInfo:
    """Channels and strides of a backbone's `Features`.

    >>> info = FeatureInfo(matching_channels=96, matching_stride=4, guide_channels={2: 32, 4: 96, 8: 64})
    >>> info.channels_at(8), info.channels_at(32)
    (64, 64)
    """

    matching_channels: int
    matching_stride: int
    guide_channels: Mapping[int, int]

    @property
    def coarsest_guide(self) -> int:
        """Stride of the coarsest guide, 0 without one; the network averages it down where a coarser one is wanted."""
        return max(self.guide_channels, default=0)

    def channels_at(self, stride: int) -> int | None:
        """Channels of the guide at `stride`, given or averaged down from the coarsest; None where there is none."""
        if self.guide_channels and stride > self.coarsest_guide and stride % self.coarsest_guide == 0:
            return self.guide_channels[self.coarsest_guide]
        return self.guide_channels.get(stride)


class GuidanceFactory(Protocol):
    """Makes one guidance block: a class such as `GCE`, or a partial of one."""

    def __call__(self, *, guide_channels: int, volume_channels: int) -> nn.Module:
        """A module ``(volume (B, C, D, H, W), guide (B, G, H, W)) -> volume`` of the volume's shape."""


class Backbone(Protocol):
    """Images to features, shared by both views."""

    info: FeatureInfo
    multiple: int
    """Height and width of the input are multiples of this."""

    def __call__(self, images: Tensor) -> Features:
        """(B, 3, H, W) normalised images to features."""


class Cost(Protocol):
    """Left and right matching features to a cost volume."""

    in_channels: int
    out_channels: int
    levels: int

    def __call__(self, left: Tensor, right: Tensor) -> Tensor:
        """Two (B, in_channels, h, w) maps to (B, out_channels, levels, h, w)."""


class Aggregation(Protocol):
    """Cost volume to logits, with the help of the guides."""

    in_channels: int
    guide_channels: Mapping[int, int]
    """The guides that it reads: channels by stride. Empty without guidance."""
    multiple: int
    """Levels, height and width of the volume are multiples of this."""
    upscale: int
    """The logits are this many times finer than the volume, in all three dimensions."""
    auxiliary_weights: tuple[float, ...]
    """Weight in the loss of each head but the last, which has weight 1."""

    def __call__(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """(B, in_channels, D, h, w) to one (B, D * upscale, h * upscale, w * upscale) per head, the best one last.

        In eval mode it may return the last head alone.
        """


class Regression(Protocol):
    """Logits to disparity, in levels.

    A regression may also have a method ``with_confidence(logits)`` that returns what `__call__` and `confidence` do,
    where the two share work.
    """

    min_levels: int
    """The fewest levels that it can work on."""

    def __call__(self, logits: Tensor, candidates: Tensor | None = None) -> Tensor:
        """(B, D, h, w) logits, larger is better, to (B, h, w), the expected candidate (0, 1, .., D - 1 by default)."""

    def confidence(self, logits: Tensor) -> Tensor:
        """(B, D, h, w) logits to (B, h, w) in [0, 1]: the probability mass behind the estimate."""


class Upsampler(Protocol):
    """From the stride of the logits to full resolution."""

    scale: int
    """The stride of what it takes."""
    domain: Literal["volume", "disparity"]
    """What it upsamples: the logits before the regression, or the disparity after it."""
    learned: bool
    """Whether it has weights; the network then trains on the coarse disparity too."""
    guide_channels: Mapping[int, int]

    def __call__(self, x: Tensor, guides: Guides) -> Tensor:
        """Logits (B, D, h, w) to (B, D * scale, H, W), or disparity (B, h, w) to (B, H, W), its values unchanged."""


_PROTOCOLS: Mapping[str, type] = {
    "backbone": Backbone,
    "cost": Cost,
    "aggregation": Aggregation,
    "regression": Regression,
    "upsampler": Upsampler,
}


def check_interface(slot: str, block: object) -> None:
    """Raises `ConfigError` unless a block has all the attributes of its slot; names those that it lacks."""
    protocol = _PROTOCOLS[slot]
    wanted = (name for name in (*protocol.__annotations__, *vars(protocol)) if not name.startswith("_"))
    missing = [name for name in wanted if not hasattr(block, name)]
    if missing:
        raise ConfigError(
            f"{slot} {type(block).__name__} lacks {', '.join(missing)}; see stereokit.contracts.{protocol.__name__}"
        )


def check_contracts(
    *,
    backbone: Backbone,
    cost: Cost,
    aggregation: Aggregation,
    regression: Regression,
    upsampler: Upsampler,
    max_disparity: int,
) -> None:
    """Holds each block to what its neighbours give.

    Raises:
        ConfigError: names both blocks, what the one gives and what the other wants; or a block and what it lacks.
    """
    blocks = {
        "backbone": backbone,
        "cost": cost,
        "aggregation": aggregation,
        "regression": regression,
        "upsampler": upsampler,
    }
    for slot, block in blocks.items():
        check_interface(slot, block)
    names = {slot: f"{slot} {type(block).__name__}" for slot, block in blocks.items()}
    info = backbone.info
    stride = info.matching_stride

    def same(giver: str, given: object, taker: str, wanted: object, what: str) -> None:
        if given != wanted:
            raise ConfigError(f"{names[giver]} gives {what} {given}, but {names[taker]} wants {wanted}")

    same("backbone", info.matching_channels, "cost", cost.in_channels, "matching channels:")
    step = stride * aggregation.multiple
    check_max_disparity(max_disparity, step, f"{names['backbone']} (stride {stride}) and {names['aggregation']}")
    if cost.levels * stride != max_disparity:
        raise ConfigError(
            f"{names['cost']} has {cost.levels} levels, but max_disparity {max_disparity} at stride {stride} of "
            f"{names['backbone']} wants {max_disparity // stride}"
        )
    same("cost", cost.out_channels, "aggregation", aggregation.in_channels, "volume channels:")
    for taker, wanted in (
        ("aggregation", aggregation.guide_channels),
        ("upsampler", upsampler.guide_channels),
    ):
        for guide_stride, channels in wanted.items():
            same(
                "backbone",
                info.channels_at(guide_stride),
                taker,
                channels,
                f"guide channels at stride {guide_stride}:",
            )
    out_stride, remainder = divmod(stride, aggregation.upscale)
    if remainder:
        raise ConfigError(
            f"{names['aggregation']} refines by {aggregation.upscale}, which does not divide the stride {stride} of "
            f"{names['backbone']}"
        )
    same("aggregation", out_stride, "upsampler", upsampler.scale, "logits at stride:")
    levels = regression_levels(max_disparity, out_stride, upsampler)
    if regression.min_levels > levels:
        raise ConfigError(
            f"{names['regression']} needs {regression.min_levels} levels (its k), but {names['aggregation']} with "
            f"{names['upsampler']} gives it {levels}; use k from 1 to {levels}"
        )


def regression_levels(max_disparity: int, logits_stride: int, upsampler: Upsampler) -> int:
    """How many levels reach the regression."""
    return max_disparity if upsampler.domain == "volume" else max_disparity // logits_stride


def check_max_disparity(max_disparity: int, multiple: int, blocks: str) -> None:
    """Raises `ConfigError` unless `max_disparity` is a positive multiple of `multiple`; use says which."""
    if isinstance(max_disparity, bool) or not isinstance(max_disparity, int):
        raise ConfigError(f"max_disparity is a whole number of pixels, not {max_disparity!r}")
    if max_disparity > 0 and max_disparity % multiple == 0:
        return
    below = max_disparity // multiple * multiple
    would_do = " or ".join(str(d) for d in (below, below + multiple) if d > 0) if max_disparity > 0 else str(multiple)
    raise ConfigError(
        f"max_disparity {max_disparity} is not a positive multiple of {multiple}, which {blocks} need; use {would_do}"
    )


def input_multiple(backbone: Backbone, aggregation: Aggregation, upsampler: Upsampler) -> int:
    """Height and width of the padded input are multiples of this: every stride of the network divides them."""
    return math.lcm(
        backbone.multiple,
        backbone.info.matching_stride * aggregation.multiple,
        *aggregation.guide_channels,
        *upsampler.guide_channels,
    )
