"""GANet: aggregation along rows and columns, by weights that the image decides.

Zhang et al., "GA-Net: guided aggregation net for end-to-end stereo matching", CVPR 2019.
"""

from typing import Any

from stereokit.builder import recipe
from stereokit.weights.key_map import KeyMap, layer, publish

__all__ = ["ganet_11", "ganet_deep"]

COMMON: dict[str, Any] = {
    "backbone": "double_hourglass",
    "candidates": {"name": "uniform", "include_end": True},
    "cost": "concatenation",
    "guidance": "semi_global",
    "guidance_at": "full",
    "regression": "local_guided",
    "upsampler": {"name": "trilinear", "include_end": True},
    "statistics": "image",
}

ganet_deep = recipe(
    "ganet_deep",
    "An hourglass run through twice at stride 3, concatenation, a 3D hourglass twice with seven SGA, LGA, soft-argmin.",
    aggregation={"name": "repeated_hourglass", "passes": 2},
    **COMMON,
)
ganet_11 = recipe(
    "ganet_11",
    "GANet-deep with the 3D hourglass once, and so four SGA.",
    aggregation={"name": "repeated_hourglass", "passes": 1},
    **COMMON,
)


def _step(published: str, ours: str) -> list[tuple[str, str]]:
    """A `ResampleStep`."""
    return [*layer(f"{published}conv1.", f"{ours}resample."), *layer(f"{published}conv2.", f"{ours}merge.")]


def _guided(number: int, ours: str) -> list[tuple[str, str]]:
    """A `SemiGlobalGuidance`, whose weights are made elsewhere in the published network."""
    return [
        (f"guidance.weight_sg{number}.", f"{ours}point.block.weights."),
        (f"cost_agg.sga{number}.bn_relu.0.", f"{ours}point.block.norm."),
        *layer(f"cost_agg.sga{number}.conv_refine.", f"{ours}point.block.refine."),
        *layer(f"guidance.conv{number}.", f"{ours}deepen.{6 if number > 10 else 3}."),
    ]


def _pass(letter: str, number: int) -> list[tuple[str, str]]:
    """A pass through the 3D hourglass; in the first one the way down has no skips."""
    ours = f"aggregation.passes.{number}."
    down = layer if number == 0 else _step
    return [
        *(pair for n in (1, 2) for pair in down(f"cost_agg.conv{n}{letter}.", f"{ours}down{n}.")),
        *(pair for n in (1, 2) for pair in _step(f"cost_agg.deconv{n}{letter}.", f"{ours}up{n}.")),
        *_guided(11 + 2 * number, f"{ours}guide1."),
        *_guided(12 + 2 * number, f"{ours}guide2."),
        *_guided(2 + number, f"{ours}guide3."),
    ]


HOURGLASS = KeyMap(
    [
        *(pair for n in range(4) for pair in layer(f"conv{n + 1}a.", f"down1.{n}.")),
        *(pair for n in range(4) for pair in _step(f"deconv{n + 1}a.", f"up1.{3 - n}.")),
        *(pair for n in range(4) for pair in _step(f"conv{n + 1}b.", f"down2.{n}.")),
        *(pair for n in range(4) for pair in _step(f"deconv{n + 1}b.", f"up2.{3 - n}.")),
    ]
)

KEYS = (
    *layer("feature.conv_start.{n}.", "backbone.stem.{n}."),
    *HOURGLASS.under("feature.", "backbone.hourglass."),
    *layer("conv_x.", "backbone.left_head."),
    *layer("conv_y.", "backbone.right_head."),
    *layer("conv_start.{n}.", "backbone.guidance.image.{n}."),
    ("conv_refine.", "backbone.guidance.feature."),
    ("bn_relu.0.", "backbone.guidance.norm."),
    *layer("guidance.conv0.", "backbone.guidance.merge."),
    *layer("guidance.conv1.{n}.", "backbone.guidance.third.{n}."),
    *layer("guidance.conv11.{n}.", "backbone.guidance.sixth.{n}."),
    *layer("cost_agg.conv_start.", "aggregation.stem."),
    *(
        (published, ours.replace("guidance.point.", "guidance."))
        for published, ours in _guided(1, "aggregation.guidance.")
        if "deepen" not in ours
    ),
    *_pass("a", 0),
    *_pass("b", 1),
    ("cost_agg.disp{n}.conv32x1.", "aggregation.heads.{n}."),
    *layer("guidance.weight_lg1.0.", "regression.of_logits.0."),
    ("guidance.weight_lg1.1.", "regression.of_logits.1."),
    *layer("guidance.weight_lg2.0.", "regression.of_probability.0."),
    ("guidance.weight_lg2.1.", "regression.of_probability.1."),
)

for name in ("ganet_deep", "ganet_11"):
    publish(
        name,
        source="the authors' checkpoints",
        licence="MIT",
        overrides={"padding": "zeros", "corner": "top_left"},
        negated=("cost_agg.disp",),
        unused=("cost_agg.deconv0b.",),
        keys=KEYS,
    )
