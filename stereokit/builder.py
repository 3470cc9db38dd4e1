"""Networks by name: recipes and overrides."""

from collections.abc import Callable, Mapping
from typing import Any, cast

from stereokit.choices import SLOTS
from stereokit.compose import compose
from stereokit.config import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    ModelConfig,
    Presets,
    rebuild,
)
from stereokit.errors import ConfigError
from stereokit.model import StereoModel
from stereokit.network import StereoNetwork
from stereokit.registry import MODELS, WEIGHTS, suggest
from stereokit.weights.shipped import default_weights, load_weights

__all__ = ["DEFAULTS", "build_model", "recipe"]

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
