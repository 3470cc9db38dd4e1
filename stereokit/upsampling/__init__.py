"""Logits or disparity to a finer resolution."""

from stereokit.upsampling.image_superpixel import ImageSuperpixelUpsampler
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
    "ImageSuperpixelUpsampler",
    "NoUpsampler",
    "SuperpixelUpsampler",
    "TrilinearUpsampler",
    "bilinear_upsample",
    "superpixel_upsample",
    "trilinear_upsample",
]
