"""A shallow stem on an image."""

from torch import nn

from stereokit.layers.convolution import ConvNormAct, Norm, relu

__all__ = ["image_stem"]


def image_stem(in_channels: int, out_channels: int, *, norm: Norm = "batch") -> nn.Sequential:
    """Two 3x3 convolutions, the first of which halves the size.

    Source: CoEx, section "Matching cost computation".

    >>> import torch
    >>> image_stem(3, 8)(torch.rand(1, 3, 6, 10)).shape
    torch.Size([1, 8, 3, 5])
    """
    return nn.Sequential(
        ConvNormAct(in_channels, out_channels, stride=2, norm=norm),
        ConvNormAct(out_channels, out_channels, norm=norm, activation=relu),
    )
