"""GC-Net.

Kendall et al., "End-to-end learning of geometry and context for deep stereo regression", ICCV 2017.
"""

from typing import Any

from stereokit.builder import compose
from stereokit.config import ModelConfig, Presets
from stereokit.model import StereoModel
from stereokit.models.preprocessing import IMAGENET_MEAN, IMAGENET_STD
from stereokit.registry import MODELS

__all__ = ["gcnet"]

RECIPE: ModelConfig = {
    "name": "gcnet",
    "backbone": {"name": "residual"},
    "cost": {"name": "concatenation"},
    "guidance": {"name": "none"},
    "guidance_at": "one",
    "aggregation": {"name": "encoder_decoder"},
    "regression": {"name": "soft_argmin"},
    "upsampler": {"name": "none"},
    "max_disparity": 192,
    "mean": IMAGENET_MEAN,
    "std": IMAGENET_STD,
    "padding": "replicate",
}

PRESETS: Presets = {"cost": {"correlation": {"projection": [32, 32]}}}


@MODELS.register("gcnet")
def gcnet(**overrides: Any) -> StereoModel:
    """Residual features at stride 2, concatenation, a deep encoder-decoder, soft-argmin at full resolution.

    Args:
        overrides: see `stereokit.build_model`.

    >>> sum(p.numel() for p in gcnet().parameters())
    2845376
    """
    return compose(RECIPE, PRESETS, overrides)
