"""GwcNet: correlation by groups alone (G), or beside a concatenation (GC).

Guo et al., "Group-wise correlation stereo network", CVPR 2019.
"""

from typing import Any

from stereokit.builder import recipe
from stereokit.models.psmnet import TRUNK
from stereokit.weights.key_map import KeyMap, publish

__all__ = ["GWC_HOURGLASS", "gwcnet_g", "gwcnet_gc"]

CORRELATION = {"name": "groupwise_correlation", "group_channels": 8}
CONCATENATION = {"name": "concatenation", "projection": {"widths": [128, 12], "activation": "relu", "bias": False}}
COMMON: dict[str, Any] = {
    "backbone": "gwc_trunk",
    "stride": 4,
    "aggregation": "gwc_hourglass",
    "regression": "soft_argmin",
    "upsampler": "trilinear",
}

gwcnet_g = recipe(
    "gwcnet_g", "Correlation by 40 groups at stride 4, three hourglasses, soft-argmin.", cost=CORRELATION, **COMMON
)
gwcnet_gc = recipe(
    "gwcnet_gc",
    "GwcNet-G with a concatenation of 12 channels of each view beside the correlation.",
    cost={"name": "combined", "parts": [CORRELATION, CONCATENATION]},
    **COMMON,
)

GWC_HOURGLASS = KeyMap(
    [
        ("dres{n}.0.", "pair{n}.0."),
        ("dres{n}.2.", "pair{n}.1."),
        ("dres{n}.conv{m}.0.{k}.", "hourglass{n-1}.conv{m}.{k}."),
        ("dres{n}.conv{m}.", "hourglass{n-1}.conv{m}."),
        ("dres{n}.redir{m}.", "hourglass{n-1}.skip{m}."),
        ("classif{n}.0.", "head{n}.0."),
        ("classif{n}.2.", "head{n}.1."),
    ]
)
"""Its aggregation, which networks after it have too."""

AUTHORS: dict[str, Any] = {
    "source": "the authors' checkpoints",
    "licence": "MIT",
    "overrides": {"padding": "zeros", "corner": "top_right"},
}
KEYS = (*TRUNK.under("feature_extraction.", "backbone."), *GWC_HOURGLASS.under("", "aggregation."))

publish("gwcnet_g", keys=KEYS, **AUTHORS)
publish(
    "gwcnet_gc",
    keys=[
        *KEYS,
        ("feature_extraction.lastconv.0.", "cost.parts.1.projection.layers.0."),
        ("feature_extraction.lastconv.2.", "cost.parts.1.projection.layers.1."),
    ],
    **AUTHORS,
)
