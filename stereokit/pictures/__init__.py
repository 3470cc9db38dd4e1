"""Pictures of disparity. Every picture is RGB, uint8, (H, W, 3); maps may be arrays or tensors, (H, W), in pixels."""

from stereokit.pictures.colors import colorize, overlay, robust_range
from stereokit.pictures.distribution import distribution_figure
from stereokit.pictures.errors import KITTI_ERROR_COLORS, error_picture
from stereokit.pictures.scale import captioned, picture_with_scale

__all__ = [
    "KITTI_ERROR_COLORS",
    "captioned",
    "colorize",
    "distribution_figure",
    "error_picture",
    "overlay",
    "picture_with_scale",
    "robust_range",
]
