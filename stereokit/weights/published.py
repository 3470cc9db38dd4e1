"""Published checkpoints, turned into networks of this library.

What is known of each format stands beside its network, see `stereokit.weights.key_map`. Variants (cost volume,
guidance) are read off the weights; what these can't tell, such as k, is an override.
"""

import logging
import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

import torch
from torch import Tensor

from stereokit.config import IMAGENET_MEAN, IMAGENET_STD, rebuild
from stereokit.errors import CheckpointError, ConfigError
from stereokit.registry import suggest
from stereokit.weights.folder import check_state
from stereokit.weights.key_map import PUBLISHED, ChannelOrder, Published
from stereokit.weights.places import check_no_program

if TYPE_CHECKING:
    from stereokit.network import StereoNetwork

__all__ = ["ConversionReport", "convert_published", "load_published", "published_networks"]

logger = logging.getLogger("stereokit")

WRAPPERS = ("state_dict", "model_state_dict", "model_state", "model", "net")
"""Where trainers keep the weights in their checkpoints."""

PREFIXES = ("module.", "stereo.", "model.")
"""Of modules that hold the network, which are left out."""


@dataclass(frozen=True)
class ConversionReport:
    """What became of the keys of a published checkpoint.

    >>> print(ConversionReport("coex", "bgr", 2, ("conv_up.0.bn.weight",), {"cost": "correlation"}))
    2 tensors loaded (cost=correlation); 1 dropped, which the published network never uses: conv_up.0.bn.weight
    """

    network: str
    channel_order: ChannelOrder
    loaded: int
    dropped: tuple[str, ...]
    variant: Mapping[str, Any]

    def __str__(self) -> str:
        read_off = ", ".join(f"{k}={v}" for k, v in self.variant.items())
        loaded = f"{self.loaded} tensors loaded{f' ({read_off})' if read_off else ''}"
        dropped = f"{len(self.dropped)} dropped, which the published network never uses: {', '.join(self.dropped)}"
        return f"{loaded}; {dropped if self.dropped else 'none dropped'}"


def published_networks() -> list[str]:
    """The networks whose published checkpoints can be read.

    >>> "coex" in published_networks()
    True
    """
    return sorted({published.network for published in PUBLISHED})


def load_published(
    path: str | os.PathLike[str],
    network: str | None = None,
    channel_order: ChannelOrder | None = None,
    **overrides: Any,
) -> "StereoNetwork":
    """Loads a published checkpoint into a network of this library, in eval mode.

    Args:
        path: a checkpoint of the authors, or a bare state dict of the same keys.
        network: its name, see `published_networks`; None for the one whose table has a place for every key.
        channel_order: of the images that the weights were trained on; None for that of the authors. The first layers of
            "bgr" weights are turned around, so that the network here sees RGB as all do.
        overrides: what the weights can't tell, see `build_model`: ``top_k=6``,
            ``upsampler={"padding": "zeros"}`` for the published behaviour at the border, ...

    Raises:
        CheckpointError: the file is missing, truncated, would run code, or its keys are not those of this network; or
            no network claims it, or several do.

    Weights that the published network never uses are dropped, and named in the log at level INFO.
    """
    return convert_published(path, network, channel_order, **overrides)[0]


def convert_published(
    path: str | os.PathLike[str],
    network: str | None = None,
    channel_order: ChannelOrder | None = None,
    **overrides: Any,
) -> tuple["StereoNetwork", ConversionReport]:
    """`load_published`, with a report of what became of the keys."""
    if network is not None and network not in published_networks():
        raise ConfigError(
            f"no published format is known for network {network!r}; {suggest(network, published_networks())}"
        )
    if channel_order is not None and channel_order not in get_args(ChannelOrder):
        raise ConfigError(f"channel_order={channel_order!r} is unknown; use 'bgr' or 'rgb'")
    source = os.fspath(path)
    state = _read_state_dict(source)
    published = _claimant(state, network, source)
    order = channel_order or published.images
    variant = _variant(published, state, source)
    settings = {**_settings(published, variant, order), **overrides}
    used = {key: value for key, value in state.items() if not published.is_unused(key)}
    ours = _in_our_terms(published, used, order)
    with torch.device("meta"):
        # without data: sizes that are read off a damaged file take no memory
        check_state(rebuild({"name": published.network}, **settings).state_dict(), ours, source)
    model: StereoNetwork = rebuild({"name": published.network}, **settings)
    model.load_state_dict(ours)
    dropped = tuple(key for key in state if key not in used)
    report = ConversionReport(published.network, order, len(used), dropped, variant)
    logger.info("%s: %s", source, report)
    return model.eval(), report


def _claimant(state: Mapping[str, Tensor], network: str | None, source: str) -> Published:
    """The format of a checkpoint."""
    formats = [published for published in PUBLISHED if network in (None, published.network)]
    placed = [published for published in formats if not published.left_over(state)]
    fitting = [published for published in placed if _fits(published, state, source)] if len(placed) > 1 else placed
    names = sorted({published.network for published in fitting})
    if len(names) == 1:
        return fitting[0]
    if names:
        raise CheckpointError(
            f"{source!r} may be of {' or '.join(map(repr, names))}; name one: network=... (--model ...)"
        )
    if placed and network is not None:
        return placed[0]
    nearest, keys = min(((p, p.left_over(state)) for p in formats), key=lambda found: len(found[1]))
    if network is None and len(keys) > len(state) / 2:
        raise CheckpointError(
            f"{source!r} is of no network whose published keys are known ({', '.join(published_networks())}); its keys "
            f"begin {_few(state)}"
        )
    others = [] if network is None else sorted({p.network for p in PUBLISHED if not p.left_over(state)})
    hint = f"; it is a {others[0]}: use network={others[0]!r} (--model {others[0]})" if others else ""
    what = f"no published {network}" if network else "of no network that is known"
    raise CheckpointError(
        f"{source!r} is {what}: nearest comes {nearest.network} ({nearest.source}), which has no place for "
        f"{_few(keys)}{hint}"
    )


def _fits(published: Published, state: Mapping[str, Tensor], source: str) -> bool:
    """Whether a network that is built without data takes exactly these weights."""
    used = {key: value for key, value in state.items() if not published.is_unused(key)}
    settings = _settings(published, _variant(published, state, source), published.images)
    with torch.device("meta"):
        wanted = rebuild({"name": published.network}, **settings).state_dict()
    ours = _in_our_terms(published, used, published.images)
    return ours.keys() == wanted.keys() and all(ours[key].shape == value.shape for key, value in wanted.items())


def _settings(published: Published, variant: Mapping[str, Any], order: ChannelOrder) -> dict[str, Any]:
    """What the network is built with."""
    settings = {**published.overrides, **variant}
    if order == "bgr":
        # the published code normalised BGR images with the RGB numbers: blue with the mean and std of red
        mean, std = settings.get("mean", IMAGENET_MEAN), settings.get("std", IMAGENET_STD)
        settings |= {"mean": list(mean)[::-1], "std": list(std)[::-1]}
    return settings


def _variant(published: Published, state: Mapping[str, Tensor], source: str) -> dict[str, Any]:
    try:
        return {} if published.variant is None else published.variant(state)
    except (KeyError, IndexError) as error:
        raise CheckpointError(
            f"{source!r} is no published {published.network}: its variant can't be read off its weights ({error})"
        ) from error


def _in_our_terms(published: Published, state: Mapping[str, Tensor], order: ChannelOrder) -> dict[str, Tensor]:
    ours: dict[str, Tensor] = {}
    for key, value in state.items():
        renamed = published.keys.rename(key)
        assert renamed is not None
        ours[renamed] = -value if any(key.startswith(prefix) for prefix in published.negated) else value
    if order == "bgr":
        for key in published.first_layers:
            if key in ours and ours[key].dim() > 1:
                # behind the image there may be more, such as a disparity to be mended
                ours[key] = torch.cat((ours[key][:, :3].flip(1), ours[key][:, 3:]), dim=1)
    return ours if published.convert is None else published.convert(ours)


def _few(keys: Any) -> str:
    """The first of several keys."""
    listed = list(keys)
    more = f", ... ({len(listed)} in all)" if len(listed) > 3 else ""
    return ", ".join(map(repr, listed[:3])) + more if listed else "none"


def _read_state_dict(path: str) -> dict[str, Tensor]:
    """The tensors of a checkpoint or bare state dict, without the prefixes of what held the network."""
    check_no_program(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise CheckpointError(f"the checkpoint {path!r} does not exist") from error
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"{path!r} is no checkpoint of tensors alone: loading it would run code, or it is no checkpoint at all"
        ) from error
    except Exception as error:
        # damaged files can make the unpickler raise anything
        raise CheckpointError(f"the checkpoint {path!r} can't be read: it is truncated, or no checkpoint") from error
    state = content
    for wrapper in WRAPPERS:
        if isinstance(state, dict) and isinstance(state.get(wrapper), dict):
            state = state[wrapper]
            break
    if not isinstance(state, dict) or not all(isinstance(k, str) and isinstance(v, Tensor) for k, v in state.items()):
        raise CheckpointError(
            f"{path!r} holds no state dict: expected tensors by name, or a Lightning checkpoint of them"
        )
    return {_without_prefix(key): value for key, value in state.items()}


def _without_prefix(key: str) -> str:
    for prefix in PREFIXES:
        key = key.removeprefix(prefix)
    return key
