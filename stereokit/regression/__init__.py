"""Logits to disparity, and disparity to full resolution."""

from stereokit.regression.interpolation import (
    BilinearUpsampler,
    NoUpsampler,
    TrilinearUpsampler,
    bilinear_upsample,
    trilinear_upsample,
)
from stereokit.regression.soft_argmin import (
    SoftArgmin,
    TopKSoftArgmin,
    soft_argmin,
    top_k_mass,
    top_k_soft_argmin,
)
from stereokit.regression.superpixel import SuperpixelUpsampler, superpixel_upsample

__all__ = [
    "BilinearUpsampler",
    "NoUpsampler",
    "SoftArgmin",
    "SuperpixelUpsampler",
    "TopKSoftArgmin",
    "TrilinearUpsampler",
    "bilinear_upsample",
    "soft_argmin",
    "superpixel_upsample",
    "top_k_mass",
    "top_k_soft_argmin",
    "trilinear_upsample",
]
