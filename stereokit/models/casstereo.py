"""CasStereo: a cascade of two stages, on the features of PSMNet or of GwcNet.

Gu et al., "Cascade cost volume for high-resolution multi-view stereo and stereo matching", CVPR 2020.
"""

from typing import Any

from stereokit.builder import recipe
from stereokit.models.gwcnet import CONCATENATION, CORRELATION, GWC_HOURGLASS
from stereokit.models.psmnet import BRANCHES, TRUNK
from stereokit.weights.key_map import publish

__all__ = ["casstereo_gwc", "casstereo_psm"]

FIRST: dict[str, Any] = {"stride": 4, "loss_weight": 0.5, "candidates": {"name": "uniform", "per_plane": 4}}
COMMON: dict[str, Any] = {
    "candidates": {"name": "neighborhood_range", "planes": 24},
    "aggregation": "gwc_hourglass",
    "regression": "soft_argmin",
    "upsampler": "trilinear",
}

casstereo_psm = recipe(
    "casstereo_psm",
    "Spatial pyramid features at strides 4 and 2, concatenation around the disparity before, three hourglasses twice.",
    backbone={
        "name": "top_down_pyramid",
        "base": {"name": "spatial_pyramid", "bias": True, "full_size": True},
        "finest": 2,
    },
    coarse=[FIRST],
    cost={"name": "concatenation", "masked": False},
    **COMMON,
)
casstereo_gwc = recipe(
    "casstereo_gwc",
    "Three residual layers concatenated, at strides 4 and 2, GwcNet's volume around the disparity before, hourglasses.",
    backbone={
        "name": "top_down_pyramid",
        "base": {"name": "gwc_trunk", "full_size": True},
        "finest": 2,
        "smooth": False,
    },
    coarse=[FIRST | {"cost": {"name": "combined", "parts": [CORRELATION, CONCATENATION]}}],
    cost={
        "name": "combined",
        "parts": [CORRELATION, {"name": "concatenation", "projection": {"widths": [6], "bias": False}}],
    },
    **COMMON,
)

AUTHORS: dict[str, Any] = {
    "source": "the authors' checkpoints",
    "licence": "MIT",
    "overrides": {"padding": "zeros", "corner": "top_right", "candidates": {"published": True}},
}
KEYS = (
    ("feature_extraction.firstconv_a.0.", "backbone.base.stem.0."),
    ("feature_extraction.firstconv_a.2.", "backbone.base.stem.1."),
    ("feature_extraction.firstconv_b.0.", "backbone.base.stem.2."),
    *TRUNK.under("feature_extraction.", "backbone.base."),
    ("feature_extraction.inner1.", "backbone.laterals.2."),
    ("feature_extraction.out2.", "backbone.heads.2."),
    *GWC_HOURGLASS.under("cost_agg.0.", "coarse.0.aggregation."),
    *GWC_HOURGLASS.under("cost_agg.1.", "aggregation."),
)

publish(
    "casstereo_psm",
    keys=[
        *KEYS,
        *BRANCHES.under("feature_extraction.", "backbone.base."),
        ("feature_extraction.inner0.0.", "backbone.base.fuse.0."),
        ("feature_extraction.inner0.2.", "backbone.base.fuse.1."),
        ("feature_extraction.lastconv.", "backbone.heads.4."),
    ],
    **AUTHORS,
)
publish(
    "casstereo_gwc",
    keys=[
        *KEYS,
        ("feature_extraction.out1_cat.0.", "coarse.0.cost.parts.1.projection.layers.0."),
        ("feature_extraction.out1_cat.2.", "coarse.0.cost.parts.1.projection.layers.1."),
        ("feature_extraction.out2_cat.", "cost.parts.1.projection.layers.0."),
    ],
    **AUTHORS,
)
