"""Blocks composed into a network: the choices of a recipe, with some of them overridden."""

from collections.abc import Mapping
from typing import Any, cast

from torch import nn

from stereokit.checks import check_max_disparity, check_stride
from stereokit.choices import SLOTS, Choice, GuidanceMaker
from stereokit.config import (
    Component,
    ModelConfig,
    Presets,
    as_json,
    expand_shorthands,
    merged,
)
from stereokit.contracts import Backbone, FeatureInfo
from stereokit.errors import ConfigError
from stereokit.model import StereoModel
from stereokit.network import Preprocessing
from stereokit.registry import suggest
from stereokit.stage import Stage, scales_of

__all__ = ["compose"]

STAGE_SLOTS = ("candidates", "cost", "guidance", "aggregation", "regression", "upsampler")
"""What a stage is made of, in the order of the figure."""


def compose(recipe: ModelConfig, presets: Presets, overrides: Mapping[str, Any]) -> StereoModel:
    """Builds the network of a recipe with some of its choices overridden.

    Args:
        recipe: the default choice for every slot.
        presets: arguments for components that may be chosen in place of the default ones.
        overrides: see `build_model`.

    Raises:
        ConfigError: see `build_model`.
    """
    overrides = dict(overrides)
    pretrained = bool(overrides.pop("pretrained_backbone", False))
    expand_shorthands(overrides)
    _check_names(recipe, presets, overrides)
    choice: dict[str, Any] = {**recipe, **{key: merged(recipe.get(key), o) for key, o in overrides.items()}}
    _check_effects(recipe, overrides)
    seen = Choice("backbone", choice["backbone"], recipe["backbone"], presets)
    backbone = cast(Backbone, seen.build(pretrained=pretrained))
    stride = backbone.info.finest if choice["stride"] is None else choice["stride"]
    common = {"max_disparity": choice["max_disparity"], "info": backbone.info, "backbone": str(seen)}
    stages, coarse = [], []
    for number, settings in enumerate(choice["coarse"]):
        given = _coarse_settings(settings, choice, first=number == 0)
        blocks, resolved = _build_stage(given, choice, presets, **common)
        stages.append(Stage(**blocks, stride=given["stride"], loss_weight=given["loss_weight"]))
        coarse.append({**resolved, "stride": given["stride"], "loss_weight": given["loss_weight"]})
    refinements = [Choice("refinement", given, presets=presets) for given in choice["refinements"]]
    ends_at = _stride_of(refinements[0]) if refinements else 1
    blocks, resolved = _build_stage({**choice, "stride": stride}, recipe, presets, ends_at=ends_at, **common)
    mended = [
        refinement.build(
            **({"stride": 1} if refinement.chosen("stride") is None else {}),
            guide_channels={1: 3, **backbone.info.guide_channels},
            max_disparity=choice["max_disparity"],
        )
        for refinement in refinements
    ]
    parts = {
        **resolved,
        "backbone": seen.resolved,
        "coarse": coarse,
        "refinements": [r.resolved for r in refinements],
        "stride": stride,
    }
    return StereoModel(
        backbone=backbone,
        **blocks,
        coarse=stages,
        refinements=mended,
        max_disparity=choice["max_disparity"],
        stride=stride,
        preprocessing=Preprocessing(
            mean=choice["mean"],
            std=choice["std"],
            statistics=choice["statistics"],
            padding=choice["padding"],
            corner=choice["corner"],
        ),
        config=as_json({**choice, **parts}),
    )


def _build_stage(
    settings: Mapping[str, Any],
    default: Mapping[str, Any],
    presets: Presets,
    *,
    max_disparity: int,
    info: FeatureInfo,
    backbone: str,
    ends_at: int = 1,
) -> tuple[dict[str, Any], dict[str, Component]]:
    """The blocks of one stage, and their resolved configuration."""
    stride = settings["stride"]
    check_stride(info, stride, backbone)
    slots = {slot: Choice(slot, settings[slot], default[slot], presets) for slot in STAGE_SLOTS if slot != "guidance"}
    if slots["candidates"].plainly("uniform", but_for="per_plane"):
        # now: blocks may fail on planes that are not whole
        per_plane = slots["candidates"].arguments.get("per_plane", 1)
        step = stride * slots["aggregation"].attribute("planes_multiple", 1)
        step *= per_plane if isinstance(per_plane, int) and per_plane > 0 else 1
        check_max_disparity(max_disparity, step, f"{backbone} (stride {stride}) and {slots['aggregation']}")
    candidates = slots["candidates"].build(max_disparity=max_disparity, stride=stride)
    cost = slots["cost"].build(in_channels=info.matching_channels[stride], planes=candidates.planes)
    aggregation, guidance = _build_aggregation(slots["aggregation"], settings, default, presets, cost, info)
    given = stride // aggregation.upscale
    if given % ends_at and slots["upsampler"].takes("scale"):
        raise ConfigError(
            f"the first refinement works at stride {ends_at}, but {slots['aggregation']} gives logits of stride "
            f"{given}; use a stride that divides it"
        )
    upsampler = slots["upsampler"].build(
        scale=given // ends_at,
        stride=given,
        guide_channels={1: 3, **info.guide_channels},
    )
    regression = slots["regression"].build(
        stride=given // upsampler.scale if upsampler.domain == "volume" else given,
        guide_channels={1: 3, **info.guide_channels},
    )
    blocks = {
        "candidates": candidates,
        "cost": cost,
        "coarser_costs": _coarser_costs(slots["cost"], cost, scales_of(aggregation), stride, info),
        "aggregation": aggregation,
        "regression": regression,
        "upsampler": upsampler,
    }
    return blocks, {**{slot: choice.resolved for slot, choice in slots.items()}, **guidance}


def _coarser_costs(choice: Choice, finest: Any, scales: int, stride: int, info: FeatureInfo) -> list[Any]:
    """The cost again at each further scale that the backbone has maps of; none of a block that was made elsewhere."""
    costs: list[Any] = []
    for scale in range(1, scales if choice.block is None else 1):
        channels = info.matching_channels.get(stride << scale)
        if channels is None:
            break
        costs.append(choice.build(in_channels=channels, planes=finest.planes >> scale))
    return costs


def _build_aggregation(
    choice: Choice,
    settings: Mapping[str, Any],
    default: Mapping[str, Any],
    presets: Presets,
    cost: Any,
    info: FeatureInfo,
) -> tuple[Any, dict[str, Any]]:
    """The aggregation with its guidance, and the configuration of the latter."""
    if choice.block is not None:
        # it has its guidance, if any, in itself
        return choice.build(), {"guidance": choice.resolved, "guidance_at": default["guidance_at"]}
    maker = GuidanceMaker(Choice("guidance", settings["guidance"], default["guidance"], presets))
    stride = settings["stride"]
    aggregation = choice.build(
        in_channels=cost.out_channels,
        planes=cost.planes,
        stride=stride,
        guide_channels={s: c for s in (stride << i for i in range(6)) if (c := info.channels_at(s))},
        guidance=maker if maker.guides else None,
        guidance_at=settings["guidance_at"],
    )
    if maker.guides and not maker.made:
        raise ConfigError(
            f"{choice} has no place for {maker.choice}, which would have no effect; use guidance='none', or an "
            "aggregation that takes guidance"
        )
    return aggregation, {"guidance": maker.choice.resolved, "guidance_at": settings["guidance_at"]}


def _stride_of(refinement: Choice) -> int:
    """Of what a refinement gives, 1 unless it was chosen."""
    stride = 1 if (given := refinement.chosen("stride")) is None else given
    if isinstance(stride, bool) or not isinstance(stride, int) or stride < 1:
        raise ConfigError(f"{refinement} has stride {stride!r}; expected a whole number from 1 up")
    return stride


def _coarse_settings(settings: Any, choice: Mapping[str, Any], *, first: bool) -> dict[str, Any]:
    """All that a coarse stage is built from: its own settings, and those of the last stage."""
    known = ("stride", "loss_weight", "guidance_at", *STAGE_SLOTS)
    if not isinstance(settings, Mapping) or "stride" not in settings:
        raise ConfigError(
            f"a coarse stage is a dict with a stride and what differs from the last stage; got {settings!r}"
        )
    unknown = [key for key in settings if key not in known]
    if unknown:
        raise ConfigError(f"a coarse stage takes no {unknown[0]!r}; {suggest(unknown[0], list(known))}")
    inherited = {key: choice[key] for key in ("guidance_at", *STAGE_SLOTS)}
    if first:
        # there is nothing before it to look around
        inherited["candidates"] = {"name": "uniform"}
    for slot in STAGE_SLOTS:
        if slot not in settings and isinstance(inherited[slot], nn.Module):
            raise ConfigError(
                f"the {slot} was passed in as a module, which can't be in two stages; give coarse stages their own"
            )
    return {"loss_weight": 1.0, **inherited, **settings}


def _check_names(recipe: ModelConfig, presets: Presets, overrides: Mapping[str, Any]) -> None:
    for key in overrides:
        if key not in recipe or key == "name":
            known = [k for k in recipe if k != "name"] + ["pretrained_backbone", "top_k"]
            raise ConfigError(f"model {recipe['name']!r} takes no argument {key!r}; {suggest(key, known)}")
    for slot, components in presets.items():
        for name in components:
            if slot not in SLOTS or name not in SLOTS[slot]:
                raise ConfigError(f"recipe {recipe['name']!r} has presets for {slot} {name!r}, which nobody takes")


def _check_effects(recipe: ModelConfig, overrides: Mapping[str, Any]) -> None:
    """Refuses choices for guidance that would change nothing."""
    aggregation, guidance = overrides.get("aggregation"), overrides.get("guidance", recipe["guidance"])
    marked = isinstance(guidance, Mapping) and "instance" in guidance
    if isinstance(aggregation, nn.Module) and "guidance" in overrides and not marked:
        raise ConfigError(
            f"aggregation {type(aggregation).__name__} was passed in as a module, with its guidance in it, so that the "
            "guidance given would have no effect; leave it out"
        )
    name = guidance.get("name") if isinstance(guidance, Mapping) else guidance
    placement = overrides.get("guidance_at", recipe["guidance_at"])
    if name == "none" and placement in ("one", "full") and placement != recipe["guidance_at"]:
        raise ConfigError(
            f"guidance_at={placement!r} has no effect with guidance 'none'; leave it out, or name a guidance"
        )
