"""CoEx: Correlate-and-Excite.

Bangunharcana et al., "Correlate-and-Excite: real-time stereo matching via guided cost volume excitation", IROS 2021.
"""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from stereokit.builder import recipe
from stereokit.weights.key_map import KeyMap, layer, publish

__all__ = ["DECODER", "EXCITED", "MOBILENET", "PAIR", "STEMS", "SUPERPIXELS", "coex"]

coex = recipe(
    "coex",
    "MobileNetV2 U-Net, cosine correlation at stride 4, an hourglass excited at every scale, top-2, superpixels.",
    backbone={"name": "unet", "encoder": "mobilenetv2_100"},
    cost="correlation",
    guidance="gce",
    guidance_at="full",
    aggregation="hourglass",
    regression={"name": "top_k", "k": 2},
    upsampler="superpixel",
    presets={
        "cost": {
            "correlation": {"projection": [48, 48]},
            "groupwise_correlation": {"projection": [48, 48]},
            "concatenation": {"projection": [48, 24]},
        },
    },
)


def _variant(state: Mapping[str, Tensor]) -> dict[str, Any]:
    cost = "correlation" if state["cost_agg.conv_stem.conv.weight"].shape[1] == 1 else "concatenation"
    if not any(key.startswith("cost_agg.channelAtt") for key in state):
        return {"cost": cost, "guidance": "none"}
    full = any(key.startswith("cost_agg.channelAttDown.") for key in state)
    return {"cost": cost, "guidance": "gce", "guidance_at": "full" if full else "one"}


MOBILENET = KeyMap(
    [
        ("block0.0.", "stages.0.0."),
        ("block1.0.", "stages.0.1."),
        ("block2.0.", "stages.1."),
        ("block3.", "stages.2."),
        ("block4.0.", "stages.3."),
        ("conv_stem.", "conv_stem."),
        ("bn1.", "bn1."),
    ]
)
"""timm's MobileNetV2 as its users cut it, in `MobileNetV2Encoder`."""


EXCITED = KeyMap([*layer("im_att.0.", "block.network.0."), ("im_att.1.", "block.network.1.")])
"""A GCE."""

PAIR = KeyMap([*layer("0.", "0."), *layer("1.", "1.")])
"""Two layers in a row."""

STEMS = KeyMap(
    [
        *layer("stem_{n}.0.", "stem_{n}.0."),
        ("stem_{n}.1.", "stem_{n}.1.0."),
        ("stem_{n}.2.", "stem_{n}.1.1."),
    ]
)
DECODER = KeyMap(
    [
        *layer("deconv{n}_{m}.conv1.", "up_{m}.up."),
        *layer("deconv{n}_{m}.conv2.", "up_{m}.merge."),
        *layer("conv4.", "merge_4."),
    ]
)
"""What `UNet` has beside its encoder."""

SUPERPIXELS = KeyMap(
    [
        *layer("spx_4.0.", "stem.0."),
        ("spx_4.1.", "stem.1.0."),
        ("spx_4.2.", "stem.1.1."),
        *layer("spx_2.conv1.", "up.0."),
        *layer("spx_2.conv2.", "merge.0."),
        ("spx.0.", "head."),
    ]
)
"""`SuperpixelUpsampler` at stride 4."""


publish(
    "coex",
    source="the authors' Lightning checkpoints",
    licence="GPL-3.0",
    images="bgr",
    variant=_variant,
    first_layers=("backbone.encoder.conv_stem.weight", "backbone.stem_2.0.0.weight"),
    unused=("cost_agg.conv_skip.0.", "cost_agg.conv_agg.0.", "cost_agg.channelAtt.0.", "cost_agg.conv_up.0.bn."),
    keys=[
        *MOBILENET.under("feature.", "backbone.encoder."),
        *DECODER.under("up.", "backbone."),
        *STEMS.under("", "backbone."),
        *layer("cost_volume.conv.", "cost.projection.layers.0."),
        ("cost_volume.desc.", "cost.projection.layers.1."),
        *layer("cost_agg.conv_stem.", "aggregation.stem."),
        *EXCITED.under("cost_agg.channelAttStem.", "aggregation.stem_guidance."),
        *PAIR.under("cost_agg.conv_down.{n}.", "aggregation.down{n+1}.convs."),
        *EXCITED.under("cost_agg.channelAttDown.{n}.", "aggregation.down{n+1}.guidance."),
        ("cost_agg.conv_up.0.conv.", "aggregation.up1."),
        *layer("cost_agg.conv_up.{n}.", "aggregation.up{n+1}.up."),
        *layer("cost_agg.conv_skip.{n}.", "aggregation.up{n+1}.merge."),
        *PAIR.under("cost_agg.conv_agg.{n}.", "aggregation.up{n+1}.convs."),
        *EXCITED.under("cost_agg.channelAtt.{n}.", "aggregation.up{n+1}.guidance."),
        *SUPERPIXELS.under("", "upsampler."),
    ],
)
