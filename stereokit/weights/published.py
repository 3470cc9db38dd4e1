"""Published checkpoints, turned into networks of this library.

The authors of CoEx publish Lightning checkpoints whose keys begin with ``stereo.``; the PSMNet here is that of CoEx's
ablation. The variant (cost volume, guidance) is read off the keys; what weights can't tell, such as k, is an override.
"""

import logging
import os
import pickle
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import torch
from torch import Tensor

from stereokit.config import IMAGENET_MEAN, IMAGENET_STD, rebuild
from stereokit.errors import CheckpointError, ConfigError
from stereokit.registry import suggest
from stereokit.weights.folder import load_state
from stereokit.weights.places import check_no_program

if TYPE_CHECKING:
    from stereokit.network import StereoNetwork

__all__ = ["ChannelOrder", "ConversionReport", "convert_published", "load_published"]

logger = logging.getLogger("stereokit")

ChannelOrder = Literal["bgr", "rgb"]

Rules = list[tuple[str, str]]

# In both networks a layer of convolution and norm is published as `conv` and `bn`, and numbered 0 and 1 here.
_LAYER: Rules = [(r"\.conv\.(weight|bias)$", r".0.\1"), (r"\.bn\.(\w+)$", r".1.\1")]

_COEX: Rules = [
    (r"^feature\.block([01])\.0\.", r"backbone.encoder.stages.0.\1."),
    (r"^feature\.block2\.0\.", "backbone.encoder.stages.1."),
    (r"^feature\.block3\.", "backbone.encoder.stages.2."),
    (r"^feature\.block4\.0\.", "backbone.encoder.stages.3."),
    (r"^feature\.", "backbone.encoder."),
    (r"^up\.deconv\d+_(\d+)\.conv1\.", r"backbone.up_\1.up."),
    (r"^up\.deconv\d+_(\d+)\.conv2\.", r"backbone.up_\1.merge."),
    (r"^up\.conv4\.", "backbone.merge_4."),
    (r"^stem_([24])\.0\.", r"backbone.stem_\1.0."),
    (r"^stem_([24])\.1\.", r"backbone.stem_\1.1.0."),
    (r"^stem_([24])\.2\.", r"backbone.stem_\1.1.1."),
    (r"^cost_volume\.conv\.", "cost.projection.layers.0."),
    (r"^cost_volume\.desc\.", "cost.projection.layers.1."),
    (r"^cost_agg\.conv_stem\.", "aggregation.stem."),
    (r"^cost_agg\.channelAttStem\.im_att\.", "aggregation.stem_guidance.block.network."),
    (r"^cost_agg\.conv_down\.0\.", "aggregation.down1.convs."),
    (r"^cost_agg\.conv_down\.1\.", "aggregation.down2.convs."),
    (r"^cost_agg\.conv_down\.2\.", "aggregation.down3.convs."),
    (r"^cost_agg\.channelAttDown\.0\.im_att\.", "aggregation.down1.guidance.block.network."),
    (r"^cost_agg\.channelAttDown\.1\.im_att\.", "aggregation.down2.guidance.block.network."),
    (r"^cost_agg\.channelAttDown\.2\.im_att\.", "aggregation.down3.guidance.block.network."),
    (r"^cost_agg\.conv_up\.0\.conv\.", "aggregation.up1."),
    (r"^cost_agg\.conv_up\.1\.", "aggregation.up2.up."),
    (r"^cost_agg\.conv_up\.2\.", "aggregation.up3.up."),
    (r"^cost_agg\.conv_skip\.1\.", "aggregation.up2.merge."),
    (r"^cost_agg\.conv_skip\.2\.", "aggregation.up3.merge."),
    (r"^cost_agg\.conv_agg\.1\.", "aggregation.up2.convs."),
    (r"^cost_agg\.conv_agg\.2\.", "aggregation.up3.convs."),
    (r"^cost_agg\.channelAtt\.1\.im_att\.", "aggregation.up2.guidance.block.network."),
    (r"^cost_agg\.channelAtt\.2\.im_att\.", "aggregation.up3.guidance.block.network."),
    (r"^spx_4\.0\.", "upsampler.stem.0."),
    (r"^spx_4\.1\.", "upsampler.stem.1.0."),
    (r"^spx_4\.2\.", "upsampler.stem.1.1."),
    (r"^spx_2\.conv1\.", "upsampler.up.0."),
    (r"^spx_2\.conv2\.", "upsampler.merge.0."),
    (r"^spx\.0\.", "upsampler.head."),
    *_LAYER,
]

_PSMNET: Rules = [
    (r"^feature_extraction\.firstconv\.0\.", "backbone.stem.0."),
    (r"^feature_extraction\.firstconv\.2\.", "backbone.stem.1."),
    (r"^feature_extraction\.firstconv\.4\.", "backbone.stem.2."),
    (r"^feature_extraction\.(layer\d\.\d+)\.conv1\.0\.", r"backbone.\1.conv1."),
    (r"^feature_extraction\.(layer\d\.\d+)\.conv2\.", r"backbone.\1.conv2."),
    (r"^feature_extraction\.(layer\d\.\d+)\.downsample\.", r"backbone.\1.skip."),
    (r"^feature_extraction\.branch4\.1\.", "backbone.branches.0.conv."),
    (r"^feature_extraction\.branch3\.1\.", "backbone.branches.1.conv."),
    (r"^feature_extraction\.branch2\.1\.", "backbone.branches.2.conv."),
    (r"^feature_extraction\.branch1\.1\.", "backbone.branches.3.conv."),
    (r"^feature_extraction\.lastconv\.0\.", "backbone.fuse.0."),
    (r"^feature_extraction\.lastconv\.2\.", "backbone.fuse.1."),
    (r"^cost_volume\.conv\.", "cost.projection.layers.0."),
    (r"^cost_volume\.desc\.", "cost.projection.layers.1."),
    (r"^conv_stem\.", "aggregation.stem."),
    (r"^channelAtt\.im_att\.", "aggregation.guidance.block.network."),
    (r"^dres([01])\.0\.", r"aggregation.pair\1.0."),
    (r"^dres([01])\.2\.", r"aggregation.pair\1.1."),
    (r"^dres2\.(conv[134])\.0\.", r"aggregation.hourglass1.\1."),
    (r"^dres3\.(conv[134])\.0\.", r"aggregation.hourglass2.\1."),
    (r"^dres4\.(conv[134])\.0\.", r"aggregation.hourglass3.\1."),
    (r"^dres2\.(conv[256])\.", r"aggregation.hourglass1.\1."),
    (r"^dres3\.(conv[256])\.", r"aggregation.hourglass2.\1."),
    (r"^dres4\.(conv[256])\.", r"aggregation.hourglass3.\1."),
    (r"^classif([123])\.0\.", r"aggregation.head\1.0."),
    (r"^classif([123])\.2\.", r"aggregation.head\1.1."),
    *_LAYER,
]


def _coex_variant(state: Mapping[str, Tensor]) -> dict[str, Any]:
    return {
        "cost": "correlation" if state["cost_agg.conv_stem.conv.weight"].shape[1] == 1 else "concatenation",
        "guidance": "gce" if any(k.startswith("cost_agg.channelAtt") for k in state) else "none",
        "guidance_at": "full" if any(k.startswith("cost_agg.channelAttDown.") for k in state) else "one",
    }


def _psmnet_variant(state: Mapping[str, Tensor]) -> dict[str, Any]:
    return {
        "cost": "correlation" if "conv_stem.conv.weight" in state else "concatenation",
        "guidance": "gce" if any(k.startswith("channelAtt.") for k in state) else "none",
        "guidance_at": "one",
    }


@dataclass(frozen=True)
class _Published:
    """What has to be known of a published network to load it."""

    fingerprint: str
    """A key that this network has and the others lack."""
    variant: Callable[[Mapping[str, Tensor]], dict[str, Any]]
    rules: Rules
    unused: str
    """Weights that the checkpoint holds but the published forward pass never reaches."""
    first_layers: tuple[str, ...]
    """Ours that see the image."""


NETWORKS: dict[str, _Published] = {
    "coex": _Published(
        fingerprint="cost_agg.conv_stem.conv.weight",
        variant=_coex_variant,
        rules=_COEX,
        unused=r"^cost_agg\.(conv_skip\.0|conv_agg\.0|channelAtt\.0|conv_up\.0\.bn)\.",
        first_layers=("backbone.encoder.conv_stem.weight", "backbone.stem_2.0.0.weight"),
    ),
    "psmnet": _Published(
        fingerprint="dres0.0.0.weight",
        variant=_psmnet_variant,
        rules=_PSMNET,
        unused=r"^$",
        first_layers=("backbone.stem.0.0.weight",),
    ),
}


@dataclass(frozen=True)
class ConversionReport:
    """What became of the keys of a published checkpoint.

    >>> print(ConversionReport(loaded=2, dropped=("conv_up.0.bn.weight",), variant={"cost": "correlation"}))
    2 tensors loaded (cost=correlation); 1 dropped, which the published network never uses: conv_up.0.bn.weight
    """

    loaded: int
    dropped: tuple[str, ...]
    variant: Mapping[str, Any]

    def __str__(self) -> str:
        read_off = ", ".join(f"{k}={v}" for k, v in self.variant.items())
        dropped = f"{len(self.dropped)} dropped, which the published network never uses: {', '.join(self.dropped)}"
        return f"{self.loaded} tensors loaded ({read_off}); {dropped if self.dropped else 'none dropped'}"


def load_published(
    path: str | os.PathLike[str], network: str = "coex", channel_order: ChannelOrder = "bgr", **overrides: Any
) -> "StereoNetwork":
    """Loads a published checkpoint into a network of this library, in eval mode.

    Args:
        path: a Lightning checkpoint of the authors, or a bare state dict of the same keys.
        network: "coex" or "psmnet".
        channel_order: of the images that the weights were trained on. The authors' are "bgr"; the first layers are
            turned around then, so that the network here sees RGB as all do.
        overrides: what the weights can't tell, see `build_model`: ``top_k=6``,
            ``upsampler={"padding": "zeros"}`` for the published behaviour at the border, ..

    Raises:
        CheckpointError: the file is missing, truncated, would run code, or its keys are not those of this network;
            missing and unknown keys are named.

    Weights that the published network never uses are dropped, and named in the log at level INFO.
    """
    model, report = convert_published(path, network, channel_order, **overrides)
    logger.info("%s: %s", os.fspath(path), report)
    return model


def convert_published(
    path: str | os.PathLike[str], network: str = "coex", channel_order: ChannelOrder = "bgr", **overrides: Any
) -> tuple["StereoNetwork", ConversionReport]:
    """`load_published`, with a report of what became of the keys."""
    if network not in NETWORKS:
        raise ConfigError(f"no published format is known for network {network!r}; {suggest(network, list(NETWORKS))}")
    if channel_order not in get_args(ChannelOrder):
        raise ConfigError(f"channel_order={channel_order!r} is unknown; use 'bgr' or 'rgb'")
    source = os.fspath(path)
    state = _read_state_dict(source)
    published = NETWORKS[network]
    if published.fingerprint not in state:
        found = [name for name, other in NETWORKS.items() if other.fingerprint in state]
        hint = (
            f"it is a {found[0]}: use network={found[0]!r} (--model {found[0]})"
            if found
            else f"its keys begin {list(state)[:3]}"
        )
        raise CheckpointError(f"{source!r} is no published {network} (no {published.fingerprint}); {hint}")
    variant = published.variant(state)
    preprocessing = {"mean": IMAGENET_MEAN, "std": IMAGENET_STD}
    if channel_order == "bgr":
        # the published code normalised BGR images with the RGB numbers: blue with the mean and std of red
        preprocessing = {key: value[::-1] for key, value in preprocessing.items()}
    model: StereoNetwork = rebuild({"name": network}, **{**variant, **preprocessing, **overrides})
    used = {key: value for key, value in state.items() if not re.match(published.unused, key)}
    ours = {_rename(key, published.rules): value for key, value in used.items()}
    if channel_order == "bgr":
        for key in published.first_layers:
            if key in ours:
                ours[key] = ours[key].flip(1)
    load_state(model, ours, source)
    dropped = tuple(key for key in state if key not in used)
    return model.eval(), ConversionReport(loaded=len(ours), dropped=dropped, variant=variant)


def _rename(key: str, rules: Rules) -> str:
    """A published key in our terms: the first place that matches, then the layer inside it."""
    for pattern, replacement in rules:
        key = re.sub(pattern, replacement, key)
    return key


def _read_state_dict(path: str) -> dict[str, Tensor]:
    """The tensors of a Lightning checkpoint or bare state dict, without the prefix of the authors' module."""
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
    state = content.get("state_dict", content) if isinstance(content, dict) else None
    if not isinstance(state, dict) or not all(isinstance(k, str) and isinstance(v, Tensor) for k, v in state.items()):
        raise CheckpointError(
            f"{path!r} holds no state dict: expected tensors by name, or a Lightning checkpoint of them"
        )
    return {key.removeprefix("module.").removeprefix("stereo."): value for key, value in state.items()}
