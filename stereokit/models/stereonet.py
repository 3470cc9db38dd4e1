"""StereoNet with three and four halvings, and a refinement for each.

Khamis et al., "StereoNet: guided hierarchical refinement for real-time edge-aware depth prediction", ECCV 2018.
"""

from typing import Any

from stereokit.builder import recipe
from stereokit.weights.key_map import KeyMap, publish

__all__ = ["stereonet_8x", "stereonet_16x"]


def _refinements(halvings: int, **arguments: Any) -> list[dict[str, Any]]:
    """One at each stride between that of the features and 1, from coarse to fine."""
    return [{"name": "edge_aware", "stride": 2**n, **arguments} for n in reversed(range(halvings))]


_COMMON: dict[str, Any] = {
    "cost": "difference",
    "aggregation": "plain",
    "regression": "soft_argmin",
    "upsampler": "none",
}

stereonet_8x = recipe(
    "stereonet_8x",
    "Difference of features at stride 8, plain 3D convolutions, soft-argmin, three refinements guided by the image.",
    backbone={"name": "strided", "halvings": 3},
    refinements=_refinements(3),
    **_COMMON,
)

stereonet_16x = recipe(
    "stereonet_16x",
    "Difference of features at stride 16, plain 3D convolutions, soft-argmin, four refinements guided by the image.",
    backbone={"name": "strided", "halvings": 4},
    refinements=_refinements(4),
    **_COMMON,
)

RESIDUAL = KeyMap(
    [
        ("res_{b}.conv_{n}.", "blocks.{b}.conv{n}.0."),
        ("res_{b}.batch_norm_{n}.", "blocks.{b}.conv{n}.1."),
    ]
)
"""Its residual blocks."""

for _name, _halvings in (("stereonet_8x", 3), ("stereonet_16x", 4)):
    publish(
        _name,
        source="andrewlstewart/StereoNet_PyTorch",
        licence="Unlicense",
        images="rgb",
        first_layers=(
            "backbone.stem.0.0.weight",
            *(f"refinements.{n}.stem.0.weight" for n in range(_halvings)),
        ),
        negated=("cost_volumizer.net.segment_1_conv_0.",),
        overrides={
            "regression": {"include_end": True},
            "refinements": _refinements(_halvings, align_corners=True),
        },
        keys=[
            ("feature_extractor.net.segment_0_conv_{n}.", "backbone.stem.{n}.0."),
            *RESIDUAL.under("feature_extractor.net.segment_1_", "backbone."),
            ("feature_extractor.net.segment_2_conv_0.", "backbone.head."),
            ("cost_volumizer.net.segment_0_conv_{n}.", "aggregation.layers.{n}.0."),
            ("cost_volumizer.net.segment_0_bn_{n}.", "aggregation.layers.{n}.1."),
            ("cost_volumizer.net.segment_1_conv_0.", "aggregation.head."),
            ("refiners.{i}.net.segment_0_conv_0.", "refinements.{i}.stem.0."),
            *RESIDUAL.under("refiners.{i}.net.segment_1_", "refinements.{i}."),
            ("refiners.{i}.net.segment_2_conv_0.", "refinements.{i}.head."),
        ],
    )
