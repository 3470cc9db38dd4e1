"""Weights by name. Other packages add theirs to `WEIGHTS`, as a function that gives the folder."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, cast

from safetensors import SafetensorError
from safetensors.torch import load_file

from stereokit.errors import CheckpointError, ConfigError, InputError
from stereokit.registry import MODELS, WEIGHTS, suggest
from stereokit.runtime.provenance import file_sha256
from stereokit.weights.folder import WEIGHTS_NAME, restore

if TYPE_CHECKING:
    from stereokit.network import StereoNetwork

__all__ = [
    "DEFAULTS",
    "MANIFEST_NAME",
    "Manifest",
    "default_weights",
    "list_weights",
    "load_weights",
    "read_manifest",
    "suggest_weights",
    "weights_folder",
]

MANIFEST_NAME = "manifest.json"

DEFAULTS = {"coex": "coex.synthetic_v7"}
"""What `pretrained=True` stands for, by network."""


class Manifest(TypedDict):
    """What is known about weights."""

    name: str
    """NETWORK.TAG."""
    sha256: str
    """Of the file of weights, as `sha256sum` gives it."""
    licence: str
    network: dict[str, Any]
    """The whole `ModelConfig`, which holds the preprocessing too: mean, std, padding."""
    images: str
    """What the network takes."""
    precision: str
    """In which the weights are stored."""
    training: dict[str, Any]
    """Recipe, seed, commit, steps, pairs seen, seconds, machine, versions: the `training.json` of the run. Under
    "started_from" the same of the weights that it began with, if it did not begin with random ones; under "mean_with"
    the weights that the file is the mean of, besides those of the run."""
    results: dict[str, Any]
    """Measured errors, with the command that measures them."""


@WEIGHTS.register("coex.synthetic_v7")
def coex_synthetic_v7() -> Path:
    """CoEx, trained on scenes that this library renders and on nothing else."""
    return Path(__file__).parent / "coex.synthetic_v7"


def list_weights(pattern: str = "*") -> list[str]:
    """Names of weights that are at hand.

    Args:
        pattern: shell-style wildcard.

    >>> list_weights("coex.*")
    ['coex.synthetic_v7']
    """
    return WEIGHTS.names(pattern)


def default_weights(network: str) -> str:
    """The weights that `pretrained=True` stands for.

    Raises:
        ConfigError: there are none for this network, or several of other packages.

    >>> default_weights("coex")
    'coex.synthetic_v7'
    """
    if network in DEFAULTS:
        return DEFAULTS[network]
    known = list_weights(f"{network}.*")
    if len(known) == 1:
        return known[0]
    if known:
        raise ConfigError(f"there are several weights for {network!r}; name one of {', '.join(known)}")
    raise ConfigError(f"there are no weights for {network!r}; there are {', '.join(list_weights())}")


def suggest_weights(name: str) -> str:
    """The end of an error message about a name that stands for no weights.

    >>> suggest_weights("coex.synthetic_v1")
    "did you mean 'coex.synthetic_v7'? Known: coex, coex.synthetic_v7"
    """
    networks = [network for network in MODELS.names() if network in DEFAULTS or len(list_weights(f"{network}.*")) == 1]
    return suggest(name, [*networks, *list_weights()])


def weights_folder(name: str | Path) -> Path:
    """The folder of these weights; a `Path` is one already.

    Raises:
        ConfigError: there are none of this name.
    """
    if isinstance(name, Path):
        return name
    if name not in WEIGHTS:
        raise ConfigError(f"unknown weights {name!r}; {suggest(name, list_weights())}")
    return Path(WEIGHTS.get(name)())


def read_manifest(name: str | Path) -> Manifest:
    """What is known about these weights, given by name, or as the `Path` of a release's folder.

    Raises:
        ConfigError: there are none of this name.
        CheckpointError: the manifest is missing or damaged.

    >>> read_manifest("coex.synthetic_v7")["licence"]
    'Apache-2.0'
    """
    path = weights_folder(name) / MANIFEST_NAME
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"the manifest {str(path)!r} can't be read: {error}") from error
    missing = [key for key in Manifest.__annotations__ if not isinstance(manifest, Mapping) or key not in manifest]
    if missing:
        raise CheckpointError(f"the manifest {str(path)!r} lacks {', '.join(missing)}")
    return cast(Manifest, manifest)


def load_weights(name: str | Path, **overrides: Any) -> "StereoNetwork":
    """The network that these weights are of, with them, in eval mode.

    Args:
        name: NETWORK.TAG, see `list_weights`, or the `Path` of a release's folder.
        overrides: of the network, see `build_model`; the weights have to fit it still.

    Raises:
        ConfigError: there are no weights of this name, or an override that can't be.
        CheckpointError: the file is missing or damaged, or does not fit the network.

    >>> load_weights("coex.synthetic_v7", top_k=3).config["regression"]["k"]
    3
    """
    manifest = read_manifest(name)
    path = weights_folder(name) / WEIGHTS_NAME
    try:
        digest = file_sha256(path)
        state = load_file(path)
    except (OSError, InputError, SafetensorError) as error:
        raise CheckpointError(f"the weights {str(path)!r} can't be read: {error}") from error
    if digest != manifest["sha256"]:
        raise CheckpointError(
            f"the weights {str(path)!r} are damaged: their SHA-256 is {digest}, not {manifest['sha256']} as in the "
            "manifest; get them again, with the package if they came with it"
        )
    return restore(manifest["network"], overrides, state, manifest["name"])
