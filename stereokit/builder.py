"""Networks by name: recipes, overrides, and blocks composed into a network."""

from collections.abc import Callable, Mapping
from typing import Any, cast

from torch import nn

from stereokit.checks import check_max_disparity, check_stride
from stereokit.choices import SLOTS, Choice, GuidanceMaker
from stereokit.config import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    Component,
    ModelConfig,
    Presets,
    as_json,
    expand_shorthands,
    rebuild,
)
from stereokit.contracts import Backbone, FeatureInfo
from stereokit.errors import ConfigError
from stereokit.model import StereoModel
from stereokit.network import Preprocessing, StereoNetwork
from stereokit.registry import MODELS, WEIGHTS, suggest
from stereokit.stage import Stage
from stereokit.weights.shipped import default_weights, load_weights

__all__ = ["DEFAULTS", "build_model", "compose", "recipe"]

STAGE_SLOTS = ("candidates", "cost", "guidance", "aggregation", "regression", "upsampler")
"""What a stage is made of, in the order of the figure."""

DEFAULTS: dict[str, Any] = {
    "stride": None,
    "coarse": [],
    "candidates": {"name": "uniform"},
    "guidance": {"name": "none"},
    "guidance_at": "one",
    "refinements": [],
    "max_disparity": 192,
    "mean": list(IMAGENET_MEAN),
    "std": list(IMAGENET_STD),
    "statistics": "fixed",
    "padding": "replicate",
    "corner": "bottom_right",
}
"""What a recipe need not say."""


def build_model(model: str | Mapping[str, Any], *, pretrained: bool | str = False, **overrides: Any) -> StereoNetwork:
    """Builds a registered network.

    Args:
        model: a name, see `list_models`; or a whole configuration, such as the `config` of another network. A name with
            a tag, "coex.synthetic_v7", stands for the network with these weights, see `stereokit.list_weights`.
        pretrained: True loads the network's usual weights, a tag such as "synthetic_v7" those; then the network is in
            eval mode.
        overrides: for networks made of slots (`StereoModel`):

            - ``backbone``, ``candidates``, ``cost``, ``guidance``, ``aggregation``, ``regression``, ``upsampler``: a
              component's name (see `list_components`), a dict ``{"name": ..., **arguments}``, or the block itself. A
              dict without a name changes arguments of the recipe's own component. The name of a timm model as
              ``backbone`` stands for the U-Net over it.
            - ``refinements``: a list of such choices; they mend the disparity, one after the other.
            - ``coarse``: a list of stages ahead of the last one, each a dict with a ``stride`` and what differs.
            - ``stride``: of the maps that the last stage compares.
            - ``top_k``: short for ``regression={"name": "top_k", "k": top_k}``.
            - ``guidance_at``: "one" place or "full", at every scale.
            - ``max_disparity``: D, in pixels.
            - ``mean``, ``std``, ``statistics``, ``padding``, ``corner``: see `Preprocessing`.
            - ``pretrained_backbone``: load timm's weights for the encoder.

            For other networks, the arguments of their class.

    Returns:
        The network; its weights are random unless said otherwise.

    Raises:
        ConfigError: an unknown name or argument, one that has no effect, blocks that do not fit each other, or weights
            that there are not.
        CheckpointError: the weights do not fit the network with its overrides.

    >>> build_model("psmnet", guidance="gce", top_k=6).config["guidance_at"]
    'one'
    >>> build_model("coex", backbone="resnet18", cost={"name": "groupwise_correlation", "groups": 4}).multiple
    32
    """
    if isinstance(model, str):
        weights = _weights_of(model, pretrained)
        if weights is not None:
            return load_weights(weights, **overrides)
        model = {"name": model}
    elif pretrained:
        raise ConfigError("pretrained weights belong to a network's name, not to a configuration")
    network: StereoNetwork = rebuild(model, **overrides)
    return network


def _weights_of(model: str, pretrained: bool | str) -> str | None:
    """The name of the weights that were asked for."""
    if model not in MODELS and (model in WEIGHTS or model.partition(".")[0] in MODELS):
        return model
    if not pretrained:
        return None
    MODELS.get(model)
    if isinstance(pretrained, str):
        return f"{model}.{pretrained}"
    return default_weights(model)


def recipe(name: str, summary: str, *, presets: Presets | None = None, **choices: Any) -> Callable[..., StereoModel]:
    """Registers a network made of slots.

    Args:
        name: of the network.
        summary: what it is, in a line.
        presets: arguments for components that may be chosen in place of the recipe's own.
        choices: for each slot a name, or a dict with name and arguments; and whatever differs from `DEFAULTS`.

    Returns:
        The function that builds the network, with the overrides of `build_model`.

    Raises:
        ConfigError: the name is taken, or the recipe has no such part.

    >>> from stereokit.registry import MODELS
    >>> tiny = recipe("tiny", "An example.", backbone="residual", cost="correlation", aggregation="encoder_decoder",
    ...     regression="soft_argmin", upsampler="none")
    >>> type(tiny(max_disparity=32)).__name__, MODELS.remove("tiny")
    ('StereoModel', None)
    """
    unknown = [key for key in choices if key not in ModelConfig.__annotations__]
    if unknown:
        raise ConfigError(f"recipe {name!r}: {suggest(unknown[0], list(ModelConfig.__annotations__))}")
    named = {
        key: {"name": value} if key in SLOTS and isinstance(value, str) else value for key, value in choices.items()
    }
    settings = cast(ModelConfig, {"name": name, **DEFAULTS, **named})

    def build(**overrides: Any) -> StereoModel:
        return compose(settings, presets or {}, overrides)

    build.__name__ = build.__qualname__ = name
    build.__doc__ = f"{summary}\n\nArgs:\n    overrides: see `stereokit.build_model`.\n"
    return MODELS.register(name)(build)


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
    choice: dict[str, Any] = {**recipe, **{key: _completed(recipe.get(key), o) for key, o in overrides.items()}}
    _check_effects(recipe, overrides)
    seen = Choice("backbone", choice["backbone"], recipe["backbone"], presets)
    backbone = cast(Backbone, seen.build(pretrained=pretrained))
    stride = backbone.info.finest if choice["stride"] is None else choice["stride"]
    common = {"max_disparity": choice["max_disparity"], "info": backbone.info, "backbone": str(seen)}
    stages, coarse = [], []
    for number, settings in enumerate(choice["coarse"]):
        merged = _coarse_settings(settings, choice, first=number == 0)
        blocks, resolved = _build_stage(merged, choice, presets, **common)
        stages.append(Stage(**blocks, stride=merged["stride"], loss_weight=merged["loss_weight"]))
        coarse.append({**resolved, "stride": merged["stride"], "loss_weight": merged["loss_weight"]})
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


def _completed(component: Any, override: Any) -> Any:
    """A choice with its name; a dict without one changes arguments of the recipe's own component."""
    if not isinstance(component, Mapping):
        return override
    if isinstance(override, str):
        return {"name": override}
    nameless = isinstance(override, Mapping) and not {"name", "instance"} & override.keys()
    return {**component, **override} if nameless else override


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
    regression = slots["regression"].build()
    upsampler = slots["upsampler"].build(
        scale=stride // aggregation.upscale // ends_at,
        stride=stride // aggregation.upscale,
        guide_channels={1: 3, **info.guide_channels},
    )
    blocks = {
        "candidates": candidates,
        "cost": cost,
        "aggregation": aggregation,
        "regression": regression,
        "upsampler": upsampler,
    }
    return blocks, {**{slot: choice.resolved for slot, choice in slots.items()}, **guidance}


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
