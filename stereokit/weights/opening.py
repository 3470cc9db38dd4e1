"""From a name or a place to a network: the one door."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

from stereokit.config import rebuild
from stereokit.errors import CheckpointError, ConfigError
from stereokit.registry import MODELS, WEIGHTS, suggest
from stereokit.weights.folder import WEIGHTS_NAME, load_folder
from stereokit.weights.key_map import ChannelOrder
from stereokit.weights.places import FILE_BACKENDS, check_no_program, is_exported, is_hub_id
from stereokit.weights.published import load_published
from stereokit.weights.shipped import default_weights, list_weights, load_weights, suggest_weights, weights_folder

if TYPE_CHECKING:
    from stereokit.network import StereoNetwork

__all__ = [
    "BareName",
    "ExportedFile",
    "NetworkPlace",
    "find_network",
    "load_network",
    "open_network",
    "set_iterations",
    "trained_network",
]

BareName: TypeAlias = Literal["trained", "untrained"]
"""What the name of a registered network stands for: the network with its default weights, or with random ones."""

Kind: TypeAlias = Literal["weights", "untrained", "folder", "hub", "published", "exported"]

KINDS: dict[Kind, str] = {
    "weights": "the name of weights",
    "untrained": "the name of a network",
    "folder": "the folder of a saved network",
    "hub": "a repository of the hub",
    "published": "a published checkpoint",
    "exported": "an exported file",
}
"""For messages."""

EXPORTED = " or ".join(FILE_BACKENDS)


@dataclass(frozen=True)
class ExportedFile:
    """A file that `stereokit export` wrote, which only a backend can open, such as that of a `Predictor`.

    Args:
        path: of the file, as `os.fspath` gives it back.

    Raises:
        CheckpointError: there is no such file.
    """

    path: str

    def __post_init__(self) -> None:
        if not os.path.isfile(self.path):
            raise CheckpointError(f"the exported file {self.path!r} does not exist")

    def __fspath__(self) -> str:
        return self.path


@dataclass(frozen=True)
class NetworkPlace:
    """Where a network is, as `find_network` found it.

    Args:
        kind: what the place is.
        name: of the weights or of the untrained network, the path, or the hub id.
    """

    kind: Kind
    name: str

    def __str__(self) -> str:
        return f"{self.name!r} is {KINDS[self.kind]}"

    def file(self) -> Path | None:
        """The file with the weights; None for a repository of the hub, and for a network without weights."""
        if self.kind in ("weights", "folder"):
            return (weights_folder(self.name) if self.kind == "weights" else Path(self.name)) / WEIGHTS_NAME
        return Path(self.name) if self.kind in ("published", "exported") else None

    def check_module(self, use: str = "the network that it was exported from") -> None:
        """Checks that a torch module can be had from this place.

        Args:
            use: what to use in place of an exported file, for the message.

        Raises:
            CheckpointError: this is an exported file.
        """
        if self.kind == "exported":
            raise CheckpointError(f"{self}, which holds no torch module; use {use}")

    def check_published_options(self, **given: Any) -> None:
        """Checks that options for published checkpoints alone are not given for another place.

        Args:
            given: the options by name; None stands for one that was not given.

        Raises:
            ConfigError: options are given, and this is no published checkpoint.
        """
        named = _named(given)
        if named and self.kind != "published":
            raise ConfigError(f"{self}, and {' and '.join(named)} can only be given for published checkpoints")


def find_network(place: str | os.PathLike[str] | NetworkPlace, *, bare_name: BareName = "trained") -> NetworkPlace:
    """Finds out what a name or place stands for, without loading it.

    What lies on disk under a name goes first; then the names of weights and of networks, then the hub, which is not
    asked yet.

    Args:
        place: see `open_network`.
        bare_name: see `open_network`.

    Raises:
        ConfigError: neither a name nor a path; or a network without weights, see `trained_network`.
        CheckpointError: there is nothing at this place, or nothing that can be opened.

    >>> find_network("coex")
    NetworkPlace(kind='weights', name='coex.synthetic_v7')
    >>> find_network("psmnet", bare_name="untrained").kind
    'untrained'
    """
    if bare_name not in get_args(BareName):
        raise ConfigError(f"bare_name={bare_name!r} is unknown; use 'trained' or 'untrained'")
    if isinstance(place, NetworkPlace):
        return place
    if not isinstance(place, str | os.PathLike):
        raise ConfigError(f"a network is opened by its name or path; got {type(place).__name__}")
    name = os.fspath(place)
    if os.path.isdir(name):
        return NetworkPlace("folder", name)
    if is_exported(name):
        return NetworkPlace("exported", ExportedFile(name).path)
    if os.path.isfile(name):
        check_no_program(name)
        if Path(name).suffix.lower() == ".safetensors":
            raise CheckpointError(f"{name!r} holds weights alone; use the folder that save_pretrained wrote")
        return NetworkPlace("published", name)
    if name in WEIGHTS:
        return NetworkPlace("weights", name)
    if name in MODELS:
        return trained_network(name) if bare_name == "trained" else NetworkPlace("untrained", name)
    if is_hub_id(name):
        return NetworkPlace("hub", name)
    known = suggest_weights(name) if bare_name == "trained" else suggest(name, [*MODELS.names(), *list_weights()])
    raise CheckpointError(
        f"unknown network {name!r}, and no file or folder; {known}; or use the folder or the hub id of a saved "
        f"network, a published checkpoint, or an exported file ({EXPORTED})"
    )


def trained_network(network: str) -> NetworkPlace:
    """The default weights of a registered network.

    Raises:
        ConfigError: an unknown network, or one that has no default weights.

    >>> trained_network("coex").name
    'coex.synthetic_v7'
    """
    MODELS.get(network)
    try:
        return NetworkPlace("weights", default_weights(network))
    except ConfigError as error:
        raise ConfigError(f"{error}; or use (--weights) a saved network or a published checkpoint") from error


def open_network(
    place: str | os.PathLike[str] | NetworkPlace,
    *,
    network: str | None = None,
    channel_order: ChannelOrder | None = None,
    bare_name: BareName = "trained",
    **overrides: Any,
) -> "StereoNetwork | ExportedFile":
    """Opens a network, from wherever it is. Loading never runs code.

    Args:
        place: what lies on disk under the name goes first:

            - the folder of a saved network,
            - an exported file (.onnx, .xml),
            - a published checkpoint, see `load_published`,
            - the name of weights ("coex.synthetic_v7"), see `list_weights`,
            - the name of a network ("coex"), which stands for its default weights,
            - a repository of the Hugging Face hub, owner/name.
        network: name of the network that it has to be. A published checkpoint tells by itself which one it is.
        channel_order: "bgr" or "rgb", of the images that a published checkpoint was trained on; None for that of the
            authors.
        bare_name: "untrained" if the name of a network stands for the network with random weights. Other places have
            weights of their own, which are loaded all the same.
        overrides: of the network, see `build_model`; its weights have to fit it still.

    Returns:
        The network in eval mode; for an exported file, which only a backend can open, the `ExportedFile`.

    Raises:
        ConfigError: a network without weights, or arguments that do not go with this place.
        CheckpointError: there is nothing at this place, it is damaged, or it is another network.

    >>> open_network("coex", top_k=3).config["regression"]["k"]
    3
    """
    found = find_network(place, bare_name=bare_name)
    if found.kind == "exported":
        if given := _named({"network": network, "channel_order": channel_order, **overrides}):
            raise ConfigError(f"{found}, which is used as it was exported; leave out {' and '.join(given)}")
        return ExportedFile(found.name)
    return _load(found, network, channel_order, overrides)


def load_network(
    place: str | os.PathLike[str] | NetworkPlace,
    *,
    network: str | None = None,
    channel_order: ChannelOrder | None = None,
    bare_name: BareName = "trained",
    **overrides: Any,
) -> "StereoNetwork":
    """`open_network` for those who need a torch module; the arguments are the same.

    Raises:
        CheckpointError: an exported file; see `open_network` too.
        ConfigError: see `open_network`.

    >>> load_network("psmnet", bare_name="untrained", max_disparity=64).max_disparity
    64
    """
    found = find_network(place, bare_name=bare_name)
    found.check_module()
    return _load(found, network, channel_order, overrides)


def set_iterations(opened: "StereoNetwork | ExportedFile", count: int) -> None:
    """Sets how often a recurrent network mends its disparity in eval mode.

    Raises:
        ConfigError: it has no iterations, a file holds those that it was exported with, or fewer than one.

    >>> model = open_network("rt_igev", bare_name="untrained", max_disparity=64)
    >>> set_iterations(model, 2)
    >>> model.config["test_iterations"]
    2
    """
    if isinstance(opened, ExportedFile):
        raise ConfigError(
            f"{opened.path!r} holds the iterations that it was exported with; leave out --iterations, or export again"
        )
    network: Any = opened
    if not hasattr(network, "test_iterations"):
        raise ConfigError(f"{type(network).__name__} has no iterations; leave out --iterations")
    network.test_iterations = count


def _load(
    found: NetworkPlace, network: str | None, channel_order: ChannelOrder | None, overrides: dict[str, Any]
) -> "StereoNetwork":
    found.check_published_options(channel_order=channel_order)
    if found.kind == "published":
        return load_published(found.name, network, channel_order, **overrides)
    model: StereoNetwork
    if found.kind == "untrained":
        model = rebuild({"name": found.name}, **overrides).eval()
    elif found.kind == "weights":
        model = load_weights(found.name, **overrides)
    else:
        model = load_folder(found.name, overrides=overrides)
    kind = found.name if found.kind == "untrained" else model.config["name"]
    if network not in (None, kind):
        raise CheckpointError(
            f"{found.name!r} holds a {kind}, not a {network}; use network={kind!r} (--model {kind}), or the weights of "
            f"a {network}"
        )
    return model


def _named(given: dict[str, Any]) -> list[str]:
    """The arguments that were given, as in Python and as on the command line."""
    options = {name: "--model" if name == "network" else f"--{name.replace('_', '-')}" for name in given}
    return [f"{name} ({options[name]})" for name, value in given.items() if value is not None]
