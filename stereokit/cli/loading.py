"""Networks and predictors as the options of a command name them."""

import argparse
from typing import TYPE_CHECKING, Any

from stereokit.errors import ConfigError
from stereokit.inference import Predictor
from stereokit.weights.opening import (
    ExportedFile,
    NetworkPlace,
    find_network,
    open_network,
    set_iterations,
    trained_network,
)
from stereokit.weights.published import convert_published

if TYPE_CHECKING:
    from stereokit.network import StereoNetwork

__all__ = ["check_published_options", "find_chosen_network", "load_chosen_network", "load_predictor"]

PREDICTOR_SETTINGS = ("precision", "max_memory", "too_large", "scale", "rig", "min_disparity")


def find_chosen_network(options: argparse.Namespace) -> NetworkPlace:
    """Where the network is that `--weights` names; without it the default weights of `--model`, or of CoEx.

    Raises:
        StereoKitError: see `find_network` and `trained_network`.
    """
    if options.weights is None:
        # nothing on disk under the network's name was meant
        return trained_network(options.model or "coex")
    return find_network(options.weights)


def load_chosen_network(options: argparse.Namespace) -> "StereoNetwork":
    """The network that the options `weights`, `model`, `channel_order` and `top_k` name.

    Raises:
        StereoKitError: there is none, it is an exported file, or an option has no effect on it.
    """
    place = find_chosen_network(options)
    place.check_module()
    opened = _open(options, place)
    assert not isinstance(opened, ExportedFile)
    return opened


def load_predictor(options: argparse.Namespace, *, bit_depth: int | None = None) -> Predictor:
    """What runs the network of `load_chosen_network`, or an exported file, as the predictor's own options say.

    Raises:
        StereoKitError: see `open_network` and `Predictor`.
    """
    opened = _open(options, find_chosen_network(options))
    settings = {name: value for name in PREDICTOR_SETTINGS if (value := getattr(options, name, None)) is not None}
    return Predictor(opened, options.device, options.backend, bit_depth=bit_depth, **settings)


def check_published_options(options: argparse.Namespace) -> None:
    """Raises `ConfigError` for options of published checkpoints where no weights are given at all."""
    if options.channel_order is not None or options.top_k is not None:
        raise ConfigError(
            "--channel-order and --top-k can only be given for published checkpoints; use --weights with one, or "
            "leave them out"
        )


def _open(options: argparse.Namespace, place: NetworkPlace) -> "StereoNetwork | ExportedFile":
    """What lies at a place, as the options for networks say."""
    place.check_published_options(channel_order=options.channel_order, top_k=options.top_k)
    overrides = {} if options.top_k is None else {"top_k": options.top_k}
    settings = {"network": options.model, "channel_order": options.channel_order, **overrides}
    opened = _open_published(options, place, settings) if place.kind == "published" else open_network(place, **settings)
    if (count := getattr(options, "iterations", None)) is not None:
        set_iterations(opened, count)
    return opened


def _open_published(options: argparse.Namespace, place: NetworkPlace, settings: dict[str, Any]) -> "StereoNetwork":
    """The network of a published checkpoint; says what was taken for granted."""
    model, report = convert_published(place.name, **settings)
    order = report.channel_order.upper()
    said = "" if options.channel_order else f", as the authors' are (--channel-order {_other(order)} if these are not)"
    print(f"{place.name}: {report.network}, {report.loaded} tensors, taken to be trained on {order} images{said}")
    return model


def _other(order: str) -> str:
    return "rgb" if order == "BGR" else "bgr"
