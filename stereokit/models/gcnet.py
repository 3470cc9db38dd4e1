"""GC-Net.

Kendall et al., "End-to-end learning of geometry and context for deep stereo regression", ICCV 2017.
"""

from stereokit.builder import recipe

__all__ = ["gcnet"]

gcnet = recipe(
    "gcnet",
    "Residual features at stride 2, concatenation, a deep encoder-decoder, soft-argmin at full resolution.",
    backbone="residual",
    cost="concatenation",
    aggregation="encoder_decoder",
    regression="soft_argmin",
    upsampler="none",
    presets={"cost": {"correlation": {"projection": [32, 32]}}},
)
