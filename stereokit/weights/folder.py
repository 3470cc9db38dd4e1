"""Networks saved with their weights: a folder with `config.json`, `model.safetensors` and a `README.md` for the hub."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import torch
from huggingface_hub import hf_hub_download
from huggingface_hub.errors import HFValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from stereokit._version import __version__
from stereokit.config import NetworkConfig, rebuild
from stereokit.errors import CheckpointError, ConfigError, StereoKitError
from stereokit.files import atomic_path, make_folder, write_json
from stereokit.weights.places import is_hub_id

if TYPE_CHECKING:
    from stereokit.network import StereoNetwork

__all__ = [
    "CONFIG_NAME",
    "WEIGHTS_NAME",
    "load_folder",
    "load_state",
    "restore",
    "save_folder",
    "saved_config",
    "write_config",
    "write_weights",
]

CONFIG_NAME = "config.json"
WEIGHTS_NAME = "model.safetensors"

MOST_NAMED = 4
"""Of what does not fit, so that a message stays a line."""


def saved_config(model: "StereoNetwork") -> NetworkConfig:
    """The configuration of a network, if it rebuilds the network.

    Raises:
        ConfigError: a block of the network was passed in as a module, so that its configuration can't rebuild it.
    """
    config = model.config
    foreign = [slot for slot, choice in config.items() if _holds_module(choice)]
    if foreign:
        raise ConfigError(
            f"the {' and '.join(foreign)} of this network was passed in as a module, which a configuration can't "
            "rebuild; register its class and build the network with its name, or save model.state_dict()"
        )
    return config


def _holds_module(choice: Any) -> bool:
    """Whether a part of a configuration stands for a module that was passed in."""
    if isinstance(choice, list):
        return any(map(_holds_module, choice))
    return isinstance(choice, dict) and ("instance" in choice or any(map(_holds_module, choice.values())))


def save_folder(model: "StereoNetwork", folder: Path) -> None:
    """Writes the configuration and the weights of a network; each file appears whole or not at all.

    Args:
        model: refused before anything is made.
        folder: is made if need be.

    Raises:
        ConfigError: see `saved_config`.
    """
    config = saved_config(model)
    make_folder(folder)
    write_weights(model.state_dict(), folder, overwrite=True)
    write_config(config, folder, overwrite=True)


def write_weights(state: Mapping[str, Tensor], folder: Path, *, overwrite: bool) -> None:
    """Writes the weights of a network."""
    with atomic_path(folder / WEIGHTS_NAME, overwrite=overwrite) as temporary:
        temporary.write_bytes(save({key: value.contiguous() for key, value in state.items()}))


def write_config(config: NetworkConfig, folder: Path, *, overwrite: bool) -> None:
    """Writes the configuration of a network, beside whose weights it makes a folder a saved network."""
    write_json(folder / CONFIG_NAME, {"stereokit": __version__, "network": config}, overwrite=overwrite)


def load_folder(
    folder_or_id: str, *, overrides: Mapping[str, Any] = MappingProxyType({}), **hub_arguments: Any
) -> "StereoNetwork":
    """Builds the network that a configuration describes and loads its weights, in eval mode.

    Args:
        folder_or_id: a folder, or a repository of the Hugging Face hub, owner/name.
        overrides: of the network, see `stereokit.build_model`; the weights have to fit it still.
        hub_arguments: of `huggingface_hub.hf_hub_download`.

    Raises:
        CheckpointError: the configuration or the weights are missing, damaged or of different networks.
        ConfigError: the configuration or an override can't be built.
    """
    path = _fetch(folder_or_id, CONFIG_NAME, hub_arguments)
    try:
        config = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise CheckpointError(f"the configuration {path!r} can't be read: {error}") from error
    if not isinstance(config, Mapping) or not isinstance(config.get("network"), Mapping):
        raise CheckpointError(f"{path!r} is not the configuration of a stereokit network")
    path = _fetch(folder_or_id, WEIGHTS_NAME, hub_arguments)
    try:
        state = load_file(path)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"the weights {path!r} can't be read: {error}") from error
    return restore(config["network"], overrides, state, path)


def restore(
    config: Mapping[str, Any], overrides: Mapping[str, Any], state: Mapping[str, Tensor], source: str
) -> "StereoNetwork":
    """Builds the network that a configuration describes, with overrides, around its weights; in eval mode.

    Args:
        config: see `stereokit.config.ModelConfig`.
        overrides: of the network, see `stereokit.build_model`.
        state: the weights, by name.
        source: where they are from, for messages.

    Raises:
        ConfigError: the configuration or an override can't be built.
        CheckpointError: the weights do not fit the network.
    """
    if _names(config, "pretrained"):
        raise CheckpointError(
            f"the configuration of {source!r} asks for other weights (pretrained); take that out of it"
        )
    try:
        with torch.device("meta"):
            # without data, so that sizes which are not those of the weights take no memory
            shaped: StereoNetwork = rebuild(config, **overrides)
    except StereoKitError:
        raise
    except (TypeError, ValueError, RuntimeError, OverflowError, AttributeError, KeyError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise CheckpointError(f"the configuration of {source!r} can't be built: {reason}") from error
    try:
        check_state(shaped.state_dict(), state, source)
    except CheckpointError as error:
        if not overrides:
            raise
        with torch.device("meta"):
            own = rebuild(config).config
        differing = [key for key, value in shaped.config.items() if own.get(key) != value]
        if not differing:
            raise
        raise CheckpointError(
            f"the weights {source!r} are of another network: it differs in {', '.join(differing)}; "
            "leave that as it is, or train it"
        ) from error
    model: StereoNetwork = rebuild(config, **overrides)
    model.load_state_dict(dict(state))
    return model.eval()


def _names(config: object, key: str) -> bool:
    """Whether a configuration has an argument of this name, that is not false, anywhere."""
    if isinstance(config, Mapping):
        return bool(config.get(key)) or any(_names(part, key) for part in config.values())
    return isinstance(config, list) and any(_names(part, key) for part in config)


def _fetch(folder_or_id: str, name: str, hub_arguments: Mapping[str, Any]) -> str:
    if os.path.isdir(folder_or_id):
        path = os.path.join(folder_or_id, name)
        if not os.path.isfile(path):
            raise CheckpointError(f"the folder {folder_or_id!r} holds no saved network: {name} is not there")
        return path
    if not is_hub_id(folder_or_id):
        raise CheckpointError(
            f"{folder_or_id!r} is no folder, and no repository of the hub, owner/name; give a folder that "
            "save_pretrained wrote"
        )
    try:
        return hf_hub_download(folder_or_id, name, **hub_arguments)
    except (OSError, HFValidationError) as error:
        reason = str(error).strip().splitlines()[0]
        raise CheckpointError(
            f"{folder_or_id!r} is no folder, and can't be read as a repository of the hub: {reason}"
        ) from error


def load_state(model: torch.nn.Module, state: Mapping[str, Tensor], source: str) -> None:
    """Loads weights that must fit exactly.

    Raises:
        CheckpointError: keys are missing or unknown, have other shapes, or values that are not finite; each is named.
    """
    check_state(model.state_dict(), state, source)
    model.load_state_dict(dict(state))


def check_state(wanted: Mapping[str, Tensor], state: Mapping[str, Tensor], source: str) -> None:
    """Raises `CheckpointError` unless weights have these names and shapes and are finite; names some that do not."""
    problems = [
        *(f"missing {key}" for key in wanted if key not in state),
        *(f"unknown {key}" for key in state if key not in wanted),
        *(
            f"{key} has shape {tuple(state[key].shape)}, not {tuple(value.shape)}"
            for key, value in wanted.items()
            if key in state and state[key].shape != value.shape
        ),
    ]
    if problems:
        raise CheckpointError(f"{source!r} does not fit the network: {_some(problems, '; ')}")
    broken = [key for key, value in state.items() if not value.isfinite().all()]
    if broken:
        raise CheckpointError(f"{source!r} holds weights that are NaN or infinite: {_some(broken, ', ')}")


def _some(parts: list[str], separator: str) -> str:
    """A few of many."""
    more = f"{separator}and {len(parts) - MOST_NAMED} more" if len(parts) > MOST_NAMED else ""
    return separator.join(parts[:MOST_NAMED]) + more
