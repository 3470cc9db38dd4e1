"""CoEx: Correlate-and-Excite.

Bangunharcana et al., "Correlate-and-Excite: real-time stereo matching via guided cost volume excitation", IROS 2021.
"""

from typing import Any

from stereokit.builder import compose
from stereokit.config import ModelConfig, Presets
from stereokit.model import StereoModel
from stereokit.models.preprocessing import IMAGENET_MEAN, IMAGENET_STD
from stereokit.registry import MODELS

__all__ = ["coex"]

RECIPE: ModelConfig = {
    "name": "coex",
    "backbone": {"name": "unet", "encoder": "mobilenetv2_100"},
    "cost": {"name": "correlation"},
    "guidance": {"name": "gce"},
    "guidance_at": "full",
    "aggregation": {"name": "hourglass"},
    "regression": {"name": "top_k", "k": 2},
    "upsampler": {"name": "superpixel"},
    "max_disparity": 192,
    "mean": IMAGENET_MEAN,
    "std": IMAGENET_STD,
    "padding": "replicate",
}

PRESETS: Presets = {
    "cost": {
        "correlation": {"projection": [48, 48]},
        "groupwise_correlation": {"projection": [48, 48]},
        "concatenation": {"projection": [48, 24]},
    },
}


@MODELS.register("coex")
def coex(**overrides: Any) -> StereoModel:
    """MobileNetV2 U-Net, cosine correlation at stride 4, an hourglass excited at every scale, top-2, superpixels.

    Args:
        overrides: see `stereokit.build_model`.

    >>> sum(p.numel() for p in coex().parameters())
    2721993
    """
    return compose(RECIPE, PRESETS, overrides)
