"""Images to matching features and guides."""

from stereokit.backbones.encoder import MobileNetV2Encoder, TimmEncoder
from stereokit.backbones.residual import ResidualTower
from stereokit.backbones.spatial_pyramid import SpatialPyramid
from stereokit.backbones.strided import StridedTower
from stereokit.backbones.unet import UNet

__all__ = ["MobileNetV2Encoder", "ResidualTower", "SpatialPyramid", "StridedTower", "TimmEncoder", "UNet"]
