"""CoEx: Correlate-and-Excite.

Bangunharcana et al., "Correlate-and-Excite: real-time stereo matching via guided cost volume excitation", IROS 2021.
"""

from stereokit.builder import recipe

__all__ = ["coex"]

coex = recipe(
    "coex",
    "MobileNetV2 U-Net, cosine correlation at stride 4, an hourglass excited at every scale, top-2, superpixels.",
    backbone={"name": "unet", "encoder": "mobilenetv2_100"},
    cost="correlation",
    guidance="gce",
    guidance_at="full",
    aggregation="hourglass",
    regression={"name": "top_k", "k": 2},
    upsampler="superpixel",
    presets={
        "cost": {
            "correlation": {"projection": [48, 48]},
            "groupwise_correlation": {"projection": [48, 48]},
            "concatenation": {"projection": [48, 24]},
        },
    },
)
