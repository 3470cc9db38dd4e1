"""LightStereo: three sizes of a network without 3D convolutions.

Guo et al., "LightStereo: channel boost is all you need for efficient 2D cost aggregation", ICRA 2025.
"""

from collections.abc import Callable
from typing import Any

from stereokit.builder import recipe
from stereokit.model import StereoModel
from stereokit.weights.key_map import KeyMap, publish

__all__ = ["lightstereo_l", "lightstereo_m", "lightstereo_s"]


def _lightstereo(size: str, blocks: tuple[int, int, int], expansion: int) -> Callable[..., StereoModel]:
    return recipe(
        f"lightstereo_{size}",
        "Feature pyramid over MobileNetV2, mean correlation at stride 4, inverted residuals over the disparities.",
        backbone={"name": "feature_pyramid", "encoder": "mobilenetv2_100"},
        cost={"name": "groupwise_correlation", "groups": 1},
        guidance="msca",
        guidance_at="full",
        aggregation={"name": "inverted_residual", "blocks": list(blocks), "expansion": expansion},
        regression="soft_argmin",
        upsampler="image_superpixel",
    )


lightstereo_s = _lightstereo("s", (1, 2, 4), 4)
lightstereo_m = _lightstereo("m", (4, 8, 16), 4)
lightstereo_l = _lightstereo("l", (8, 16, 32), 8)


ENCODER = KeyMap(
    [
        ("conv_stem.", "conv_stem."),
        ("bn1.", "bn1."),
        ("block0.", "stages.0.0."),
        ("block1.", "stages.0.1."),
        ("block2.", "stages.1."),
        ("block3.{n}.", "stages.2.{n-3}."),
        ("block4.", "stages.3."),
    ]
)
"""timm's MobileNetV2 as LightStereo cuts it, in `MobileNetV2Encoder`."""


def _inverted(published: str, ours: str) -> list[tuple[str, str]]:
    """An inverted residual."""
    parts = {"pwconv": "widen", "dwconv": "depthwise", "pwliner": "narrow"}
    return [(f"{published}{theirs}.", f"{ours}{mine}.") for theirs, mine in parts.items()]


def _attention(published: str, ours: str) -> list[tuple[str, str]]:
    """An MSCA."""
    strips = [(f"{published}conv{n}_{i}.", f"{ours}strips.{n}.{i - 1}.") for n in range(3) for i in (1, 2)]
    return [*strips, (f"{published}conv0.", f"{ours}project."), (f"{published}conv3.", f"{ours}mix.")]


def _up(published: str, ours: str) -> list[tuple[str, str]]:
    """A step of a decoder."""
    return [(f"{published}deconv.block.", f"{ours}up."), (f"{published}conv.block.", f"{ours}merge.")]


NECK = KeyMap(
    [
        *_up("fpn_layer4.", "up_16."),
        *_up("fpn_layer3.", "up_8."),
        *_up("fpn_layer2.", "up_4."),
        ("out_conv.block.", "head."),
    ]
)

HOURGLASS = KeyMap(
    [
        *_inverted("conv0.{n}.", "down1.blocks.{n}."),
        *_inverted("conv1.", "down2.blocks.0."),
        *_inverted("conv2.{n}.", "down2.blocks.{n+1}."),
        *_inverted("conv3.", "down3.blocks.0."),
        *_inverted("conv4.{n}.", "down3.blocks.{n+1}."),
        ("conv5.", "up2.up."),
        ("conv6.", "up1.up."),
        *_inverted("redir2.", "up2.skip."),
        *_inverted("redir1.", "up1.skip."),
    ]
)
"""`InvertedResidualHourglass` without its guidance."""

KEYS = (
    *ENCODER.under("backbone.", "backbone.encoder."),
    *NECK.under("neck.", "backbone."),
    # OpenStereo has the neck inside the backbone
    *NECK.under("backbone.", "backbone."),
    *HOURGLASS.under("cost_agg.", "aggregation."),
    *_attention("cost_agg.att0.", "aggregation.down1.guidance.block."),
    *_attention("cost_agg.att2.", "aggregation.down2.guidance.block."),
    *_attention("cost_agg.att4.", "aggregation.down3.guidance.block."),
    ("refine_1.{n}.block.", "upsampler.refine.{n}."),
    ("stem_2.{n}.block.", "upsampler.image_stem.{n}."),
    *_up("refine_2.", "upsampler.up.0."),
    ("refine_3.block.0.", "upsampler.head."),
)

OVERRIDES: dict[str, Any] = {"padding": "black", "corner": "top_right", "upsampler": {"padding": "zeros"}}

for size in "sml":
    publish(f"lightstereo_{size}", source="LightStereoX and OpenStereo", licence="none", keys=KEYS, overrides=OVERRIDES)
