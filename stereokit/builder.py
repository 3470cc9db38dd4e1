"""Networks by name: recipes, overrides, and the configuration that rebuilds a network."""

from collections.abc import Mapping
from typing import Any, cast

from torch import nn

from stereokit.backbones.encoder import is_timm_model, near_timm_models
from stereokit.config import Component, ModelConfig, Override, Presets, as_json, expand_top_k, rebuild
from stereokit.contracts import FeatureInfo, GuidanceFactory, check_interface, check_max_disparity
from stereokit.errors import ConfigError
from stereokit.model import StereoModel
from stereokit.registry import (
    AGGREGATIONS,
    BACKBONES,
    COSTS,
    GUIDANCE,
    MODELS,
    REGRESSIONS,
    UPSAMPLERS,
    WEIGHTS,
    Registry,
    suggest,
)
from stereokit.weights.shipped import default_weights, load_weights

__all__ = ["build_model", "compose"]

SLOTS: dict[str, Registry] = {
    "backbone": BACKBONES,
    "cost": COSTS,
    "guidance": GUIDANCE,
    "aggregation": AGGREGATIONS,
    "regression": REGRESSIONS,
    "upsampler": UPSAMPLERS,
}


def build_model(model: str | Mapping[str, Any], *, pretrained: bool | str = False, **overrides: Any) -> Any:
    """Builds a registered network.

    Args:
        model: a name, see `list_models`; or a whole configuration, such as the `config` of another network. A name with
            a tag, "coex.synthetic_v7", stands for the network with these weights, see `stereokit.list_weights`.
        pretrained: True loads the network's usual weights, a tag such as "synthetic_v7" those; then the network is in
            eval mode.
        overrides: for networks made of slots (`StereoModel`):

            - ``backbone``, ``cost``, ``guidance``, ``aggregation``, ``regression``, ``upsampler``: a component's name
              (see `list_components`), a dict ``{"name": .., **arguments}``, or the block itself. A dict without a name
              changes arguments of the recipe's own component. The name of a timm model as ``backbone`` stands for the
              U-Net over it.
            - ``top_k``: short for ``regression={"name": "top_k", "k": top_k}``.
            - ``guidance_at``: "one" place or "full", at every scale.
            - ``max_disparity``: D, in pixels.
            - ``mean``, ``std``, ``padding``: the preprocessing, see `StereoModel`.
            - ``pretrained_backbone``: load timm's weights for the encoder.

    Returns:
        The network; its weights are random unless said otherwise.

    Raises:
        ConfigError: an unknown name or argument, blocks that do not fit each other, or weights that there are not.
        CheckpointError: the weights do not fit the network with its overrides.

    >>> build_model("psmnet", guidance="gce", top_k=6).config["guidance_at"]
    'one'
    >>> build_model("coex", backbone="resnet18", cost={"name": "groupwise_correlation", "groups": 4}).multiple
    32
    """
    if isinstance(model, str):
        weights = _weights_of(model, pretrained)
        if weights is None:
            return MODELS.build(model, overrides)
        return load_weights(weights, **overrides)
    if pretrained:
        raise ConfigError("pretrained weights belong to a network's name, not to a configuration")
    return rebuild(model, **overrides)


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
    expand_top_k(overrides)
    for key in overrides:
        if key not in recipe or key == "name":
            known = [k for k in recipe if k != "name"] + ["pretrained_backbone", "top_k"]
            raise ConfigError(f"model {recipe['name']!r} takes no argument {key!r}; {suggest(key, known)}")
    choice: dict[str, Any] = {**recipe, **overrides}
    slots = {slot: _Slot(slot, recipe, presets, choice[slot]) for slot in SLOTS}

    backbone = slots["backbone"].build(pretrained=pretrained)
    info: FeatureInfo = backbone.info
    stride, max_disparity = info.matching_stride, choice["max_disparity"]
    step = stride * getattr(slots["aggregation"].source, "multiple", 1)
    check_max_disparity(max_disparity, step, f"{slots['backbone']} (stride {stride}) and {slots['aggregation']}")
    cost = slots["cost"].build(in_channels=info.matching_channels, levels=max_disparity // stride)
    aggregation = slots["aggregation"].build(
        in_channels=cost.out_channels,
        stride=stride,
        guide_channels={s: c for s in (stride << i for i in range(6)) if (c := info.channels_at(s))},
        guidance=slots["guidance"].factory(),
        guidance_at=choice["guidance_at"],
    )
    regression = slots["regression"].build()
    upsampler = slots["upsampler"].build(scale=stride // aggregation.upscale, guide_channels=dict(info.guide_channels))
    resolved = {**choice, **{slot: s.resolved for slot, s in slots.items()}}
    return StereoModel(
        backbone=backbone,
        cost=cost,
        aggregation=aggregation,
        regression=regression,
        upsampler=upsampler,
        max_disparity=max_disparity,
        mean=choice["mean"],
        std=choice["std"],
        padding=choice["padding"],
        config=as_json(resolved),
    )


class _Slot:
    """One choice: a registered component with its arguments, or a block made elsewhere."""

    def __init__(self, slot: str, recipe: ModelConfig, presets: Presets, choice: Override) -> None:
        self.slot = slot
        self.registry = SLOTS[slot]
        self.block: nn.Module | None = None
        self.source: Any
        """The block or its class: says what it needs before it is built."""
        if isinstance(choice, nn.Module):
            self.block = self.source = choice
            self.resolved: Component = {"instance": f"{type(choice).__module__}.{type(choice).__qualname__}"}
            return
        default: Component = recipe[slot]  # type: ignore[literal-required]
        given: Component = {"name": choice} if isinstance(choice, str) else choice
        if not isinstance(given, Mapping):
            raise ConfigError(
                f"{slot}={choice!r}: expected a component's name, a dict {{'name': .., **arguments}} or a module"
            )
        if "instance" in given:
            raise ConfigError(
                f"the configuration was made with a {slot} of {given['instance']} that was passed in as a module, "
                f"which JSON can't rebuild; pass it again, {slot}=.., or register the class and pass its name"
            )
        arguments = dict(given)
        name = arguments.pop("name", default["name"])
        if not isinstance(name, str):
            raise ConfigError(f"the name of a {slot} is a string, not {name!r}")
        if slot == "backbone" and name not in BACKBONES:
            if not is_timm_model(name):
                near = " or ".join(map(repr, near_timm_models(name)))
                such_as = f", such as {near}" if near else ""
                raise ConfigError(
                    f"unknown backbone {name!r}; {suggest(name, BACKBONES.names())}, or the name of a timm model"
                    f"{such_as}"
                )
            arguments["encoder"] = name
            name = "unet"
        own = {k: v for k, v in default.items() if k != "name"} if name == default["name"] else {}
        self.name: str = name
        self.arguments = {**presets.get(slot, {}).get(name, {}), **own, **arguments}
        self.resolved = {"name": name, **self.arguments}
        self.source = self.registry.get(name)

    def __str__(self) -> str:
        return f"{self.slot} {self.resolved.get('name', self.resolved.get('instance'))!r}"

    def build(self, **offered: Any) -> Any:
        """The block; `offered` is what its neighbours decide."""
        if self.block is not None:
            if offered.get("pretrained"):
                raise ConfigError(f"{self} was passed in as a module, with its weights: leave out pretrained_backbone")
            check_interface(self.slot, self.block)
            return self.block
        decided = [key for key in self.arguments if key in offered and key != "pretrained"]
        if decided:
            raise ConfigError(f"{', '.join(decided)} of {self} follows from the rest of the network; leave it out")
        if offered.get("pretrained") and "pretrained" not in self.registry.parameters(self.name):
            raise ConfigError(f"{self} has no pretrained weights to load")
        self.resolved = {"name": self.name, **self.registry.resolve(self.name, self.arguments, offered)}
        # the weights that a block starts from are no part of what it is: a saved network brings its own
        self.resolved.pop("pretrained", None)
        block = self.registry.build(self.name, self.arguments, offered)
        check_interface(self.slot, block)
        return block

    def factory(self) -> GuidanceFactory | None:
        """For the guidance slot: what an aggregation calls at each of its guidance points."""
        if self.block is not None:
            return _SinglePlace(self.block)
        channels = {"guide_channels": None, "volume_channels": None}
        self.resolved = {"name": self.name, **self.registry.resolve(self.name, self.arguments, channels)}
        if self.name == "none":
            return None

        def make(*, guide_channels: int, volume_channels: int) -> nn.Module:
            offered = {"guide_channels": guide_channels, "volume_channels": volume_channels}
            return cast(nn.Module, self.registry.build(self.name, self.arguments, offered))

        return make


class _SinglePlace:
    """Lends a guidance block made elsewhere to the one place that it fits."""

    def __init__(self, block: nn.Module) -> None:
        self.block = block
        self.taken = False

    def __call__(self, *, guide_channels: int, volume_channels: int) -> nn.Module:
        kind = type(self.block).__name__
        if self.taken:
            raise ConfigError(
                f"guidance {kind} was passed in as one module, but the aggregation has several places for it; "
                "use guidance_at='one', or register the class and pass its name"
            )
        self.taken = True
        for what, wanted in (("guide_channels", guide_channels), ("volume_channels", volume_channels)):
            has = getattr(self.block, what, wanted)
            if has != wanted:
                raise ConfigError(f"guidance {kind} has {what} {has}, but the aggregation's place for it has {wanted}")
        return self.block
