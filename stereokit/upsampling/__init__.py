"""Logits or disparity to a finer resolution."""

from stereokit.upsampling.interpolation import (
    BilinearUpsampler,
    NoUpsampler,
    TrilinearUpsampler,
    bilinear_upsample,
    trilinear_upsample,
)
from stereokit.upsampling.superpixel import SuperpixelUpsampler, superpixel_upsample

__all__ = [
    "BilinearUpsampler",
    "NoUpsampler",
    "SuperpixelUpsampler",
    "TrilinearUpsampler",
    "bilinear_upsample",
    "superpixel_upsample",
    "trilinear_upsample",
]
