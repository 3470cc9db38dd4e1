"""PSMNet with stacked hourglasses.

Chang and Chen, "Pyramid Stereo Matching Network", CVPR 2018.
"""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from stereokit.builder import recipe
from stereokit.models.coex import EXCITED
from stereokit.weights.key_map import KeyMap, layer, publish

__all__ = ["BRANCHES", "FEATURES", "HEAD", "HOURGLASSES", "TRUNK", "psmnet"]

psmnet = recipe(
    "psmnet",
    "Spatial pyramid features, concatenation at stride 4, three hourglasses, soft-argmin at full resolution.",
    backbone="spatial_pyramid",
    cost="concatenation",
    aggregation="stacked_hourglass",
    regression="soft_argmin",
    upsampler="trilinear",
    presets={"cost": {"correlation": {"projection": [32, 32]}}},
)


def _variant(state: Mapping[str, Tensor]) -> dict[str, Any]:
    return {
        "cost": "correlation" if "conv_stem.conv.weight" in state else "concatenation",
        "guidance": "gce" if any(key.startswith("channelAtt.") for key in state) else "none",
    }


TRUNK = KeyMap(
    [
        ("firstconv.0.", "stem.0."),
        ("firstconv.2.", "stem.1."),
        ("firstconv.4.", "stem.2."),
        ("layer{n}.{m}.conv1.0.", "layer{n}.{m}.conv1."),
        ("layer{n}.{m}.conv2.", "layer{n}.{m}.conv2."),
        ("layer{n}.{m}.downsample.", "layer{n}.{m}.skip."),
    ]
)
"""The residual layers, which many networks after PSMNet have."""

BRANCHES = KeyMap((f"branch{4 - i}.1.", f"branches.{i}.conv.") for i in range(4))
"""The pyramid behind them."""

FEATURES = KeyMap(
    [
        *TRUNK,
        *BRANCHES,
        ("lastconv.0.", "fuse.0."),
        ("lastconv.2.", "fuse.1."),
    ]
)
"""All of its backbone."""

HOURGLASSES = KeyMap(
    [
        ("dres{n}.0.", "pair{n}.0."),
        ("dres{n}.2.", "pair{n}.1."),
        ("dres{n}.conv1.0.", "hourglass{n-1}.conv1."),
        ("dres{n}.conv3.0.", "hourglass{n-1}.conv3."),
        ("dres{n}.conv4.0.", "hourglass{n-1}.conv4."),
        ("dres{n}.conv{m}.", "hourglass{n-1}.conv{m}."),
    ]
)
"""Its aggregation, but for the heads."""

HEAD = KeyMap([("0.", "0."), ("2.", "1.")])
"""One of the heads."""

publish(
    "psmnet",
    source="the checkpoints of CoEx's ablation",
    licence="GPL-3.0",
    images="bgr",
    variant=_variant,
    first_layers=("backbone.stem.0.0.weight",),
    keys=[
        *FEATURES.under("feature_extraction.", "backbone."),
        *layer("cost_volume.conv.", "cost.projection.layers.0."),
        ("cost_volume.desc.", "cost.projection.layers.1."),
        *layer("conv_stem.", "aggregation.stem."),
        *EXCITED.under("channelAtt.", "aggregation.guidance."),
        *HOURGLASSES.under("", "aggregation."),
        *HEAD.under("classif{n}.", "aggregation.head{n}."),
    ],
)
