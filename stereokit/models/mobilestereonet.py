"""MobileStereoNet, with 2D and with 3D convolutions: GwcNet made of separable ones.

Shamsafar et al., "MobileStereoNet: towards lightweight deep networks for stereo matching", WACV 2022.
"""

from typing import Any

from stereokit.builder import recipe
from stereokit.models.gwcnet import CORRELATION
from stereokit.weights.key_map import KeyMap, publish

__all__ = ["mobilestereonet_2d", "mobilestereonet_3d"]

COMMON: dict[str, Any] = {"stride": 4, "regression": "soft_argmin", "upsampler": "trilinear"}

mobilestereonet_2d = recipe(
    "mobilestereonet_2d",
    "Separable features, interlaced volume at stride 4, three hourglasses over the disparities, soft-argmin.",
    backbone="separable_trunk",
    cost="interlaced",
    aggregation={"name": "separable_hourglass", "dims": 2},
    **COMMON,
)
mobilestereonet_3d = recipe(
    "mobilestereonet_3d",
    "Separable features, correlation by 40 groups at stride 4, three hourglasses, soft-argmin.",
    backbone={"name": "separable_trunk", "stem_activation": False},
    cost=CORRELATION,
    aggregation={"name": "separable_hourglass", "dims": 3},
    **COMMON,
)

INVERTED = KeyMap(
    (f"conv.{3 * i + j}.", f"{part}.{j}.") for i, part in enumerate(("widen", "depthwise", "narrow")) for j in (0, 1)
)
SEPARABLE = KeyMap(
    [*((f"conv{{n}}.{3 * i + j}.", f"conv{{n}}.{i}.{j}.") for i in (0, 1) for j in (0, 1)), ("downsample.", "skip.")]
)
COMMON_KEYS = (
    *SEPARABLE.under("feature_extraction.layer{m}.{k}.", "backbone.layer{m}.{k}."),
    *INVERTED.under("encoder_decoder{m}.conv{k}.", "aggregation.hourglass{m}.conv{k}."),
    *INVERTED.under("encoder_decoder{m}.redir{k}.", "aggregation.hourglass{m}.skip{k}."),
    ("encoder_decoder{m}.conv{k}.", "aggregation.hourglass{m}.conv{k}."),
    ("classif{m}.0.", "aggregation.head{m}.0."),
    ("classif{m}.2.", "aggregation.head{m}.1."),
)
AUTHORS: dict[str, Any] = {
    "source": "the authors' checkpoints",
    "licence": "Apache-2.0",
    "overrides": {"padding": "zeros", "corner": "top_right"},
}


def _pairs(step: int) -> tuple[tuple[str, str], ...]:
    """The stem and the first two pairs, whose blocks are `step` apart there."""
    return (
        *(
            pair
            for i in range(3)
            for pair in INVERTED.under(f"feature_extraction.firstconv.{step * i}.", f"backbone.stem.{i}.0.")
        ),
        *INVERTED.under("dres{m}.{k}.", "aggregation.pair{m}.{k}."),
    )


publish("mobilestereonet_3d", keys=[*COMMON_KEYS, *_pairs(1)], **AUTHORS)
publish(
    "mobilestereonet_2d",
    keys=[
        *COMMON_KEYS,
        *_pairs(2),
        ("preconv11.0.", "cost.reduction.0."),
        ("preconv11.2.", "cost.reduction.1."),
        ("preconv11.4.", "cost.reduction.2."),
        ("preconv11.6.", "cost.reduction.3."),
        *((f"conv3d.{3 * i}.", f"cost.layers.{i}.conv.") for i in range(3)),
        *((f"conv3d.{3 * i + 1}.", f"cost.layers.{i}.norm.") for i in range(3)),
        ("volume11.0.0.", "cost.merge.conv."),
        ("volume11.0.1.", "cost.merge.norm."),
    ],
    **AUTHORS,
)
