"""Logits or disparity to a finer resolution."""

from stereokit.upsampling.convex import ConvexUpsampler, ConvexWeights
from stereokit.upsampling.image_superpixel import ImageSuperpixelUpsampler
from stereokit.upsampling.interpolation import (
    BilinearUpsampler,
    NoUpsampler,
    TrilinearUpsampler,
    trilinear_upsample,
)
from stereokit.upsampling.superpixel import SuperpixelUpsampler, superpixel_upsample

__all__ = [
    "BilinearUpsampler",
    "ConvexUpsampler",
    "ConvexWeights",
    "ImageSuperpixelUpsampler",
    "NoUpsampler",
    "SuperpixelUpsampler",
    "TrilinearUpsampler",
    "superpixel_upsample",
    "trilinear_upsample",
]
