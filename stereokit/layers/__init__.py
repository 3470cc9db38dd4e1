"""Layers that blocks share."""

from stereokit.layers.convolution import ConvNormAct, at_least_float32, crop_to, init_convolutions, leaky_relu, relu
from stereokit.layers.residual import ResidualBlock

__all__ = [
    "ConvNormAct",
    "ResidualBlock",
    "at_least_float32",
    "crop_to",
    "init_convolutions",
    "leaky_relu",
    "relu",
]
