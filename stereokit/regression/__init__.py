"""Logits to disparity."""

from stereokit.regression.local_guided import LocalGuidedSoftArgmin, local_guided_aggregate
from stereokit.regression.mode import Mode, mode
from stereokit.regression.most_probable_pair import MostProbablePair, most_probable_pair
from stereokit.regression.soft_argmin import SoftArgmin, TopKSoftArgmin, soft_argmin, top_k_mass, top_k_soft_argmin
from stereokit.regression.sub_pixel_map import SubPixelMap, sub_pixel_map

__all__ = [
    "LocalGuidedSoftArgmin",
    "Mode",
    "MostProbablePair",
    "SoftArgmin",
    "SubPixelMap",
    "TopKSoftArgmin",
    "local_guided_aggregate",
    "mode",
    "most_probable_pair",
    "soft_argmin",
    "sub_pixel_map",
    "top_k_mass",
    "top_k_soft_argmin",
]
