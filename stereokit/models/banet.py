"""BANet: a volume that is split into detail and what is smooth, for two branches of 2D or of 3D convolutions.

Xu et al., "BANet: bilateral aggregation network for mobile stereo matching", ICCV 2025.
"""

from typing import Any

from torch import Tensor

from stereokit.builder import recipe
from stereokit.models.coex import EXCITED
from stereokit.models.lightstereo import ENCODER, HOURGLASS
from stereokit.weights.key_map import KeyMap, layer, publish

__all__ = ["banet_2d", "banet_3d"]

RAW: dict[str, Any] = {"mean": [0.0] * 3, "std": [1 / 255] * 3}
"""Images in 0..255: nothing is normalised."""

ACT = {"activation": "relu6", "stem_activation": "relu6", "up_kernel": 3}

banet_2d = recipe(
    "banet_2d",
    "MobileNetV2 U-Net, mean correlation at stride 4, two branches of inverted residuals over the disparities.",
    backbone={"name": "unet", "encoder": "mobilenetv2_100", "stem_channels": [16, 32], "channels": 32, **ACT},
    cost={
        "name": "groupwise_correlation",
        "groups": 1,
        "projection": {"widths": [32, 32], "activation": "relu6"},
    },
    guidance={"name": "scaling", "activation": "relu6"},
    guidance_at="full",
    aggregation={
        "name": "bilateral",
        "branch": {"name": "inverted_residual", "blocks": [4, 7, 9]},
        "channels": 32,
        "dims": 2,
        "activation": "relu6",
    },
    regression="soft_argmin",
    upsampler={"name": "superpixel", "channels": [32, 16], **ACT},
    **RAW,
)

banet_3d = recipe(
    "banet_3d",
    "MobileNetV2 U-Net, cosine correlation at stride 4, two of CoEx's hourglasses, excited between convolutions.",
    backbone={"name": "unet", "encoder": "mobilenetv2_100", "stem_activation": "leaky_relu"},
    cost={"name": "correlation", "projection": [48, 48]},
    guidance={"name": "gce", "reduction": 1},
    guidance_at="full",
    aggregation={
        "name": "bilateral",
        "branch": {"name": "hourglass", "guide_early": True},
        "channels": 8,
        "attention_channels": 64,
    },
    regression="soft_argmin",
    upsampler={"name": "superpixel", "channels": [32, 32], "stem_activation": "leaky_relu"},
    **RAW,
)

FEATURES = KeyMap(
    [
        *ENCODER.under("fnet.", "backbone.encoder."),
        *layer("fnet.deconv{n}_{m}.deconv.", "backbone.up_{m}.up."),
        *layer("fnet.deconv{n}_{m}.concat.", "backbone.up_{m}.merge."),
        *layer("fnet.conv4.", "backbone.merge_4."),
        *layer("stem_{n}.{m}.", "backbone.stem_{n}.{m}."),
    ]
)

ATTENTION = KeyMap(
    [
        *layer("conv{n}.", "embed.{n}."),
        *layer("lastconv.0.", "merge."),
        ("lastconv.1.", "head.0."),
        ("attn.", "head.1."),
    ]
)

SUPERPIXELS = KeyMap(
    [
        *layer("spx_4.{n}.", "stem.{n}."),
        *layer("spx_2.deconv.", "up.0."),
        *layer("spx_2.concat.", "merge.0."),
        ("spx.0.", "head."),
    ]
)

SHARED = (
    *FEATURES,
    *ATTENTION.under("spa_att.", "aggregation.attention."),
    *SUPERPIXELS.under("", "upsampler."),
)

AUTHORS: dict[str, Any] = {
    "source": "the authors' checkpoints",
    "licence": "MIT",
    "overrides": {"upsampler": {"padding": "zeros"}},
}

publish(
    "banet_2d",
    # a convolution that takes the mean, whose weights are frozen
    unused=("build_cv.reduce_mean.",),
    keys=[
        *SHARED,
        *layer("build_cv.conv.", "cost.projection.layers.0."),
        ("build_cv.desc.", "cost.projection.layers.1."),
        *layer("cost_stem.", "aggregation.embedding."),
        *HOURGLASS.under("cost_agg{k}.", "aggregation.branches.{k}."),
        *(
            pair
            for theirs, ours in ((0, 1), (2, 2), (4, 3))
            for pair in EXCITED.under(f"cost_agg{{k}}.att{theirs}.", f"aggregation.branches.{{k}}.down{ours}.guidance.")
        ),
        ("cost_agg{k}.conv_final.", "aggregation.heads.{k}."),
    ],
    **AUTHORS,
)


def _cosine(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The published volume is the mean over channels where ours is the sum: what reads it makes up for that."""
    channels = len(state["cost.projection.layers.1.weight"])
    state["aggregation.embedding.0.weight"] = state["aggregation.embedding.0.weight"] / channels
    return state


BRANCH = KeyMap(
    [
        *layer("conv0.", "stem."),
        *EXCITED.under("gce_4.", "stem_guidance."),
        *layer("downconv{n}.", "down{n}.convs.0."),
        *layer("conv{n}.", "down{n}.convs.1."),
        *EXCITED.under("gce_8.", "down1.guidance."),
        *EXCITED.under("gce_16.", "down2.guidance."),
        *EXCITED.under("gce_32.", "down3.guidance."),
        ("upconv3.conv.", "up1."),
        *(
            pair
            for theirs, ours, stride in ((1, 3, 16), (2, 2, 8))
            for pair in (
                *layer(f"upconv{theirs}.", f"up{ours}.up."),
                *layer(f"concat{theirs}.", f"up{ours}.merge."),
                *layer(f"agg{theirs}.0.", f"up{ours}.convs.0."),
                *layer(f"agg{theirs}.1.", f"up{ours}.convs.1."),
                *EXCITED.under(f"gce_{stride}_up.", f"up{ours}.guidance."),
            )
        ),
    ]
)

publish(
    "banet_3d",
    unused=("cost_agg{k}.upconv3.bn.",),
    convert=_cosine,
    keys=[
        *SHARED,
        *layer("conv.", "cost.projection.layers.0."),
        ("desc.", "cost.projection.layers.1."),
        *layer("corr_stem.", "aggregation.embedding."),
        *BRANCH.under("cost_agg{k}.", "aggregation.branches.{k}."),
    ],
    **AUTHORS,
)
