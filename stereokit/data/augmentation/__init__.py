"""Augmentation for training: pure functions from a `StereoSample` and a generator to a `StereoSample`."""

from stereokit.data.augmentation.appearance import (
    adjust_colour,
    colour_jitter,
    occlude_right_view,
    random_occlusion,
)
from stereokit.data.augmentation.chain import Augmentation
from stereokit.data.augmentation.geometry import (
    crop,
    flip_and_swap,
    random_crop,
    random_scale,
    scale,
    shift_right_view,
    vertical_jitter,
)

__all__ = [
    "Augmentation",
    "adjust_colour",
    "colour_jitter",
    "crop",
    "flip_and_swap",
    "occlude_right_view",
    "random_crop",
    "random_occlusion",
    "random_scale",
    "scale",
    "shift_right_view",
    "vertical_jitter",
]
