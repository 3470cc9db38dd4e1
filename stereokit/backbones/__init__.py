"""Images to matching features and guides."""

from stereokit.backbones.affinity_pyramid import AffinityPyramid
from stereokit.backbones.bottleneck_pyramid import BottleneckPyramid
from stereokit.backbones.deep_aggregation import DeepAggregation
from stereokit.backbones.deformable_hourglass import DeformableHourglass
from stereokit.backbones.double_hourglass import DoubleHourglass
from stereokit.backbones.embedding import Embedding
from stereokit.backbones.encoder import MobileNetV2Encoder, TimmEncoder
from stereokit.backbones.feature_pyramid import FeaturePyramid
from stereokit.backbones.gwc_trunk import GwcTrunk
from stereokit.backbones.level_path import LevelPathBackbone
from stereokit.backbones.residual import ResidualTower
from stereokit.backbones.separable_trunk import SeparableTrunk
from stereokit.backbones.spatial_pyramid import SpatialPyramid
from stereokit.backbones.strided import StridedTower
from stereokit.backbones.top_down_pyramid import TopDownPyramid
from stereokit.backbones.unet import UNet

__all__ = [
    "AffinityPyramid",
    "BottleneckPyramid",
    "DeepAggregation",
    "DeformableHourglass",
    "DoubleHourglass",
    "Embedding",
    "FeaturePyramid",
    "GwcTrunk",
    "LevelPathBackbone",
    "MobileNetV2Encoder",
    "ResidualTower",
    "SeparableTrunk",
    "SpatialPyramid",
    "StridedTower",
    "TimmEncoder",
    "TopDownPyramid",
    "UNet",
]
