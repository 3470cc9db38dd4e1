"""PSMNet with stacked hourglasses.

Chang and Chen, "Pyramid Stereo Matching Network", CVPR 2018.
"""

from stereokit.builder import recipe

__all__ = ["psmnet"]

psmnet = recipe(
    "psmnet",
    "Spatial pyramid features, concatenation at stride 4, three hourglasses, soft-argmin at full resolution.",
    backbone="spatial_pyramid",
    cost="concatenation",
    aggregation="stacked_hourglass",
    regression="soft_argmin",
    upsampler="trilinear",
    presets={"cost": {"correlation": {"projection": [32, 32]}}},
)
