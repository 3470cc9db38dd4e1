"""Neighbouring blocks held against each other: a list of rules, applied before any tensor flows."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from stereokit.contracts import (
    Aggregation,
    Backbone,
    Cost,
    FeatureInfo,
    Refinement,
    Regression,
    Sampler,
    Upsampler,
)
from stereokit.errors import ConfigError
from stereokit.stage import StageBlocks, guides_read, levels_of, planes_upscale, regression_guides

__all__ = ["Rule", "check_interface", "check_max_disparity", "check_network", "check_rules", "input_multiple"]

PROTOCOLS: Mapping[str, type] = {
    "backbone": Backbone,
    "candidates": Sampler,
    "cost": Cost,
    "aggregation": Aggregation,
    "regression": Regression,
    "upsampler": Upsampler,
    "refinement": Refinement,
}


OPTIONAL = {"cost": ("warps",), "aggregation": ("scales", "volume_heads"), "refinement": ("multiple",)}
"""What a block need not say: it then does not warp, has one scale, heads of no volume, and takes any size."""


class Rule(NamedTuple):
    """What one block gives, and what another one wants."""

    giver: str
    given: object
    taker: str
    wanted: object
    what: str


def check_rules(rules: Sequence[Rule]) -> None:
    """Raises `ConfigError` for the first rule that does not hold; it names both blocks and both numbers."""
    for giver, given, taker, wanted, what in rules:
        if given != wanted:
            raise ConfigError(f"{giver} gives {what} {given}, but {taker} wants {wanted}")


def check_interface(slot: str, block: object) -> None:
    """Raises `ConfigError` unless a block has all the attributes of its slot; names those that it lacks."""
    protocol = PROTOCOLS[slot]
    wanted = (name for name in (*protocol.__annotations__, *vars(protocol)) if name[0] != "_")
    missing = [name for name in wanted if not hasattr(block, name) and name not in OPTIONAL.get(slot, ())]
    if missing:
        raise ConfigError(
            f"{slot} {type(block).__name__} lacks {', '.join(missing)}; see stereokit.contracts.{protocol.__name__}"
        )


def check_network(
    *,
    backbone: Backbone,
    stages: Sequence[StageBlocks],
    refinements: Sequence[Refinement] = (),
    max_disparity: int,
) -> None:
    """Holds each block to what its neighbours give.

    Args:
        backbone: of the network.
        stages: from coarse to fine.
        refinements: in their order.
        max_disparity: D, in pixels.

    Raises:
        ConfigError: names both blocks, what the one gives and what the other wants; or a block and what it lacks.
    """
    check_interface("backbone", backbone)
    for refinement in refinements:
        check_interface("refinement", refinement)
    for number, stage in enumerate(stages):
        last = number == len(stages) - 1
        _check_stage(backbone, stage, refinements if last else (), max_disparity)
    strides = [stage.stride for stage in stages]
    if strides != sorted(strides, reverse=True):
        raise ConfigError(f"stages go from coarse to fine; these have strides {', '.join(map(str, strides))}")
    reached = stages[-1].stride // stages[-1].aggregation.upscale // stages[-1].upsampler.scale
    for refinement in refinements:
        if refinement.stride > reached:
            raise ConfigError(
                f"{_named('refinement', refinement)} works at stride {refinement.stride}, but what comes to it has "
                f"stride {reached}; use one from 1 to {reached}"
            )
        reached = refinement.stride
    if reached != 1:
        giver = refinements[-1] if refinements else stages[-1].upsampler
        slot = "refinement" if refinements else "upsampler"
        raise ConfigError(f"{_named(slot, giver)} ends at stride {reached}; the network's disparity has stride 1")
    for refinement in refinements:
        check_rules(list(_guide_rules(backbone, _named("refinement", refinement), refinement.guide_channels)))


def _check_stage(backbone: Backbone, stage: StageBlocks, refinements: Sequence[Refinement], max_disparity: int) -> None:
    slots = ("candidates", "cost", "aggregation", "regression", "upsampler")
    for slot in slots:
        check_interface(slot, getattr(stage, slot))
    names = {slot: _named(slot, getattr(stage, slot)) for slot in slots} | {"backbone": _named("backbone", backbone)}
    candidates, cost, aggregation, upsampler = stage.candidates, stage.cost, stage.aggregation, stage.upsampler
    info, stride = backbone.info, stage.stride
    check_stride(info, stride, names["backbone"])
    matching = info.matching_channels[stride]
    check_rules([Rule(names["backbone"], matching, names["cost"], cost.in_channels, "matching channels:")])
    if candidates.fixed:
        step = int(candidates.spacing) * aggregation.planes_multiple
        check_max_disparity(max_disparity, step, f"{names['backbone']} (stride {stride}) and {names['aggregation']}")
    elif not getattr(cost, "warps", False):
        raise ConfigError(
            f"{names['candidates']} gives candidates of each pixel, but {names['cost']} can't warp; use a cost whose "
            "`warps` is true, or the candidates 'uniform'"
        )
    if cost.planes != candidates.planes:
        raise ConfigError(
            f"{names['cost']} has {cost.planes} planes, but max_disparity {max_disparity} at stride {stride} of "
            f"{names['backbone']} wants {candidates.planes}"
        )
    if cost.planes % aggregation.planes_multiple:
        raise ConfigError(
            f"{names['candidates']} gives {candidates.planes} planes, but {names['aggregation']} wants a multiple of "
            f"{aggregation.planes_multiple}"
        )
    out_stride, remainder = divmod(stride, aggregation.upscale)
    if remainder:
        raise ConfigError(
            f"{names['aggregation']} refines by {aggregation.upscale}, which does not divide the stride {stride} of "
            f"{names['backbone']}"
        )
    check_rules(
        [
            Rule(names["cost"], cost.out_channels, names["aggregation"], aggregation.in_channels, "volume channels:"),
            *_guide_rules(backbone, names["aggregation"], aggregation.guide_channels),
            *_guide_rules(backbone, names["upsampler"], upsampler.guide_channels),
            *_guide_rules(backbone, names["regression"], regression_guides(stage.regression)),
        ]
    )
    coarser: Any
    for scale, coarser in enumerate(stage.coarser_costs, start=1):
        given = info.matching_channels[stride << scale]
        name = f"{_named('cost', coarser)} at stride {stride << scale}"
        check_rules(
            [
                Rule(names["backbone"], given, name, coarser.in_channels, "matching channels:"),
                Rule(name, coarser.out_channels, names["aggregation"], aggregation.in_channels, "volume channels:"),
                Rule(names["candidates"], candidates.planes >> scale, name, coarser.planes, "planes:"),
            ]
        )
    # with refinements, which can enlarge, the upsampler may end anywhere before them
    if not refinements or out_stride % upsampler.scale:
        check_rules([Rule(names["aggregation"], out_stride, names["upsampler"], upsampler.scale, "logits at stride:")])
    levels = levels_of(upsampler, cost.planes * planes_upscale(aggregation))
    if stage.regression.min_levels > levels:
        raise ConfigError(
            f"{names['regression']} needs {stage.regression.min_levels} levels (its k), but {names['aggregation']} "
            f"with {names['upsampler']} gives it {levels}; use k from 1 to {levels}"
        )


def check_stride(info: FeatureInfo, stride: int, backbone: str) -> None:
    """Raises `ConfigError` unless a backbone has a matching map of this stride."""
    if stride not in info.matching_channels:
        raise ConfigError(
            f"{backbone} has no matching features at stride {stride}; use "
            f"{' or '.join(map(str, sorted(info.matching_channels)))}"
        )


def check_max_disparity(max_disparity: int, multiple: int, blocks: str) -> None:
    """Raises `ConfigError` unless `max_disparity` is a positive multiple of `multiple`; says which to use."""
    if isinstance(max_disparity, bool) or not isinstance(max_disparity, int):
        raise ConfigError(f"max_disparity is a whole number of pixels, not {max_disparity!r}")
    if max_disparity > 0 and max_disparity % multiple == 0:
        return
    below = max_disparity // multiple * multiple
    fitting = " or ".join(str(d) for d in (below, below + multiple) if d > 0) if max_disparity > 0 else str(multiple)
    raise ConfigError(
        f"max_disparity {max_disparity} is not a positive multiple of {multiple}, which {blocks} need; use {fitting}"
    )


def input_multiple(backbone: Backbone, stages: Sequence[StageBlocks], refinements: Sequence[Refinement] = ()) -> int:
    """Height and width of the padded input are multiples of this: every stride of the network divides them."""
    return math.lcm(
        backbone.multiple,
        *(stage.stride * stage.aggregation.multiple for stage in stages),
        *(refinement.stride * getattr(refinement, "multiple", 1) for refinement in refinements),
        *guides_read(stages, refinements),
    )


def _guide_rules(backbone: Backbone, taker: str, wanted: Mapping[int, int]) -> Iterator[Rule]:
    for stride, channels in wanted.items():
        given = backbone.info.channels_at(stride)
        yield Rule(_named("backbone", backbone), given, taker, channels, f"guide channels at stride {stride}:")


def _named(slot: str, block: Any) -> str:
    return f"{slot} {type(block).__name__}"
