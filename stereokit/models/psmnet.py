"""PSMNet with stacked hourglasses.

Chang and Chen, "Pyramid Stereo Matching Network", CVPR 2018.
"""

from typing import Any

from stereokit.builder import compose
from stereokit.config import ModelConfig, Presets
from stereokit.model import StereoModel
from stereokit.models.preprocessing import IMAGENET_MEAN, IMAGENET_STD
from stereokit.registry import MODELS

__all__ = ["psmnet"]

RECIPE: ModelConfig = {
    "name": "psmnet",
    "backbone": {"name": "spatial_pyramid"},
    "cost": {"name": "concatenation"},
    "guidance": {"name": "none"},
    "guidance_at": "one",
    "aggregation": {"name": "stacked_hourglass"},
    "regression": {"name": "soft_argmin"},
    "upsampler": {"name": "trilinear"},
    "max_disparity": 192,
    "mean": IMAGENET_MEAN,
    "std": IMAGENET_STD,
    "padding": "replicate",
}

PRESETS: Presets = {"cost": {"correlation": {"projection": [32, 32]}}}


@MODELS.register("psmnet")
def psmnet(**overrides: Any) -> StereoModel:
    """Spatial pyramid features, concatenation at stride 4, three hourglasses, soft-argmin at full resolution.

    Args:
        overrides: see `stereokit.build_model`.

    >>> sum(p.numel() for p in psmnet().parameters())
    5224768
    """
    return compose(RECIPE, PRESETS, overrides)
