"""Layers that blocks share."""

from stereokit.layers.act_norm import ActNormResidual, conv_act_norm
from stereokit.layers.affinity import (
    AffinityCentre,
    AffinityFusion,
    AffinityPooling,
    affinity_convolution,
    affinity_fuse,
    affinity_pool,
    affinity_propagate,
    affinity_weights,
    check_affinity,
)
from stereokit.layers.bin_shift import bin_shift
from stereokit.layers.bottleneck import Bottleneck
from stereokit.layers.casting import as_float, at_least_float32
from stereokit.layers.conv_gru import ConvGRU
from stereokit.layers.convolution import (
    Activation,
    ConvNormAct,
    Norm,
    crop_to,
    init_convolutions,
    leaky_relu,
    named_activation,
    relu,
)
from stereokit.layers.deformable import DeformableConvolution, deformable_convolution, sampled_convolution
from stereokit.layers.image_stem import image_stem
from stereokit.layers.interpolation import bilinear_upsample
from stereokit.layers.inverted_residual import InvertedResidual
from stereokit.layers.pooling import cell_means, tent_means
from stereokit.layers.resample_step import ResampleStep
from stereokit.layers.residual import ResidualBlock, SeparableBlock, residual_layer
from stereokit.layers.searched_cell import CellNodes, LevelPath, SearchedCell, level_size, resize
from stereokit.layers.twofold_hourglass import TwofoldHourglass
from stereokit.layers.up_step import UpStep
from stereokit.layers.warp import warp

__all__ = [
    "ActNormResidual",
    "Activation",
    "AffinityCentre",
    "AffinityFusion",
    "AffinityPooling",
    "Bottleneck",
    "CellNodes",
    "ConvGRU",
    "ConvNormAct",
    "DeformableConvolution",
    "InvertedResidual",
    "LevelPath",
    "Norm",
    "ResampleStep",
    "ResidualBlock",
    "SearchedCell",
    "SeparableBlock",
    "TwofoldHourglass",
    "UpStep",
    "affinity_convolution",
    "affinity_fuse",
    "affinity_pool",
    "affinity_propagate",
    "affinity_weights",
    "as_float",
    "at_least_float32",
    "bilinear_upsample",
    "bin_shift",
    "cell_means",
    "check_affinity",
    "conv_act_norm",
    "crop_to",
    "deformable_convolution",
    "image_stem",
    "init_convolutions",
    "leaky_relu",
    "level_size",
    "named_activation",
    "relu",
    "residual_layer",
    "resize",
    "sampled_convolution",
    "tent_means",
    "warp",
]
