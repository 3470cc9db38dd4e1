"""What a network is built from, in plain JSON, and building it again from that."""

import json
from collections.abc import Mapping
from typing import Any, Literal, TypeAlias, TypedDict

from torch import nn

from stereokit.contracts import GuidancePlacement
from stereokit.errors import ConfigError
from stereokit.registry import MODELS, suggest

__all__ = [
    "IMAGENET_MEAN",
    "IMAGENET_STD",
    "Component",
    "Corner",
    "ModelConfig",
    "NetworkConfig",
    "Override",
    "Padding",
    "Presets",
    "Statistics",
    "as_json",
    "expand_shorthands",
    "merged",
    "rebuild",
]

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
"""Of the RGB channels of images in [0, 1]."""

Component: TypeAlias = dict[str, Any]
"""``{"name": ..., **arguments}``"""

Override: TypeAlias = str | Component | nn.Module
"""A component's name, its name with arguments, or the block itself."""

Presets: TypeAlias = Mapping[str, Mapping[str, Component]]
"""Arguments that a recipe gives a component when it is chosen: slot, then name, then arguments."""

NetworkConfig: TypeAlias = Mapping[str, Any]
"""``{"name": ..., **arguments}`` of any registered network; of one made of slots it is a `ModelConfig`."""


Statistics = Literal["fixed", "image"]
Padding = Literal["replicate", "zeros", "black"]
Corner = Literal["bottom_right", "top_right", "top_left"]
"""Of `Preprocessing`."""


class ModelConfig(TypedDict):
    """All that a network of slots is built from: plain JSON, in and out.

    >>> from stereokit import build_model
    >>> config = build_model("coex").config
    >>> config["regression"]
    {'name': 'top_k', 'k': 2, 'test_k': None}
    >>> build_model(json.loads(json.dumps(config))).config == config
    True
    """

    name: str
    backbone: Component
    stride: int | None
    """Of the maps that the last stage compares; None for the backbone's finest."""
    coarse: list[dict[str, Any]]
    """The stages ahead of the last one, from coarse to fine: a stride, a weight in the loss, and what differs from the
    last stage in `candidates`, `cost`, `guidance`, `guidance_at`, `aggregation`, `regression` and `upsampler`."""
    candidates: Component
    cost: Component
    guidance: Component
    guidance_at: GuidancePlacement
    aggregation: Component
    regression: Component
    upsampler: Component
    refinements: list[Component]
    max_disparity: int
    mean: list[float]
    std: list[float]
    statistics: Statistics
    padding: Padding
    corner: Corner


def rebuild(config: Mapping[str, Any], **overrides: Any) -> Any:
    """Builds the network that a configuration describes.

    Args:
        config: of a network, see `ModelConfig`.
        overrides: changes to it, see `stereokit.build_model`.

    Raises:
        ConfigError: no configuration, or one that can't be built.

    >>> from stereokit import build_model
    >>> rebuild(build_model("coex").config, top_k=3).config["regression"]["k"]
    3
    """
    if not isinstance(config, Mapping):
        raise ConfigError(f"a model is a name or a configuration, not {config!r}; {suggest('', MODELS.names())}")
    settings = dict(config)
    name = settings.pop("name", None)
    if not isinstance(name, str):
        raise ConfigError(f"a configuration holds the name of its model, one of {', '.join(MODELS.names())}")
    if "top_k" in overrides:
        settings.pop("regression", None)
    if overrides.get("guidance") in ("none", {"name": "none"}):
        # where there is none, its places are nowhere
        settings.pop("guidance_at", None)
    for slot, override in overrides.items():
        settings[slot] = merged(settings.get(slot), override)
    network = MODELS.build(name, settings)
    if not isinstance(network, nn.Module) or not hasattr(network, "match"):
        raise ConfigError(
            f"model {name!r} is a {type(network).__name__}, not a StereoNetwork; derive its class from "
            "stereokit.StereoNetwork"
        )
    if getattr(network, "_config", "none of its own") is None:
        # a registered class, which knows nothing of its name
        arguments = MODELS.resolve(name, settings, {})
        # the weights that a network starts from are no part of what it is
        arguments.pop("pretrained_backbone", None)
        network._config = as_json({"name": name, **arguments})
    return network


def merged(component: Any, override: Any) -> Any:
    """A component with its override: a dict without a name changes arguments of it, all else takes its place.

    >>> merged({"name": "correlation", "projection": None}, {"projection": [48]})
    {'name': 'correlation', 'projection': [48]}
    """
    both = isinstance(component, Mapping) and isinstance(override, Mapping)
    nameless = both and not {"name", "instance"} & override.keys()
    return {**component, **override} if nameless else override


def expand_shorthands(overrides: dict[str, Any]) -> None:
    """Turns the shorthand `top_k` into a regression, in place."""
    if "top_k" not in overrides:
        return
    if "regression" in overrides:
        raise ConfigError("top_k=... is short for a regression: give one of top_k and regression")
    overrides["regression"] = {"name": "top_k", "k": overrides.pop("top_k")}


def as_json(config: dict[str, Any]) -> Any:
    """The configuration as JSON gives it back.

    Raises:
        ConfigError: it holds something else than plain JSON values.
    """
    try:
        return json.loads(json.dumps(config))
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"the arguments of components are plain JSON values, so that a network can be saved: {error}"
        ) from error
