"""AcfNet: PSMNet with upsampling that is learned, and a loss that wants one peak, as narrow as the network is sure.

Zhang et al., "Adaptive unimodal cost volume filtering for deep stereo matching", AAAI 2020.
"""

from typing import Any

from stereokit.builder import recipe
from stereokit.models.psmnet import BRANCHES
from stereokit.weights.key_map import KeyMap, publish

__all__ = ["acfnet", "acfnet_uniform"]

UNIFORM: dict[str, Any] = {
    "name": "with_upsampling",
    "base": {"name": "stacked_hourglass", "bias": True, "third_takes": 2},
}
COMMON: dict[str, Any] = {
    "backbone": {"name": "spatial_pyramid", "align_corners": True, "skip_bias": True},
    "cost": "concatenation",
    "regression": "soft_argmin",
    "upsampler": "none",
}

acfnet = recipe(
    "acfnet",
    "PSMNet with learned upsampling of the logits, and a network that says at each pixel how sure each head is.",
    aggregation={"name": "with_confidence", "base": UNIFORM},
    **COMMON,
)
acfnet_uniform = recipe(
    "acfnet_uniform",
    "AcfNet without confidence, trained towards peaks of one width.",
    aggregation=UNIFORM,
    **COMMON,
)

BACKBONE = KeyMap(
    [
        ("firstconv.", "stem."),
        ("layer{n}.{m}.downsample.", "layer{n}.{m}.skip."),
        ("layer", "layer"),
        *BRANCHES,
        ("lastconv.", "fuse."),
    ]
)
AGGREGATION = KeyMap(
    [
        ("dres{n}.conv{m}.", "base.hourglass{n-1}.conv{m}."),
        ("dres{n}.", "base.pair{n}."),
        ("classif{n}.", "base.head{n}."),
        ("deconv{n}.", "enlarge.{n-1}."),
    ]
)
AUTHORS: dict[str, Any] = {
    "source": "DenseMatchingBenchmark",
    "licence": "MIT",
    # the disparities of the planes
    "unused": ("disp_predictor.disp_regression.weight",),
    "overrides": {"padding": "zeros", "corner": "top_right"},
}

publish(
    "acfnet",
    keys=[
        *BACKBONE.under("backbone.", "backbone."),
        *AGGREGATION.under("cost_processor.aggregator.", "aggregation.base."),
        # from the last head to the first
        *(
            (f"cmn.conf_heads.{i}.conf_net.{part}.", f"aggregation.confidence.{2 - i}.{name}.")
            for i in range(3)
            for part, name in enumerate(("hidden", "last"))
        ),
    ],
    **AUTHORS,
)
publish(
    "acfnet_uniform",
    keys=[
        *BACKBONE.under("backbone.", "backbone."),
        *AGGREGATION.under("cost_processor.aggregator.", "aggregation."),
    ],
    **AUTHORS,
)
