"""CDN: a continuous distribution on the network of PSMNet, and its mode.

Garg et al., "Wasserstein distances for stereo disparity estimation", NeurIPS 2020.
"""

from stereokit.builder import recipe
from stereokit.models.psmnet import FEATURES, HEAD, HOURGLASSES
from stereokit.weights.key_map import publish

__all__ = ["cdn_psmnet"]

cdn_psmnet = recipe(
    "cdn_psmnet",
    "PSMNet with offsets beside the logits, bins of 2 px, and the mode of the distribution in place of its mean.",
    backbone="spatial_pyramid",
    cost="concatenation",
    aggregation={"name": "with_offsets", "base": "stacked_hourglass"},
    regression="mode",
    upsampler={"name": "trilinear", "planes_scale": 2},
)

publish(
    "cdn_psmnet",
    source="the authors' checkpoints",
    licence="MIT",
    overrides={"padding": "zeros", "corner": "top_right"},
    keys=[
        *FEATURES.under("feature_extraction.", "backbone."),
        *HOURGLASSES.under("", "aggregation.base."),
        *HEAD.under("classif{n}.", "aggregation.base.head{n}.logits."),
        *HEAD.under("semantic{n}.", "aggregation.base.head{n}.offsets."),
    ],
)
