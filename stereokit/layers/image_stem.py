"""A shallow stem on an image."""

from torch import nn

from stereokit.layers.convolution import Activation, ConvNormAct, Norm, leaky_relu, relu

__all__ = ["image_stem"]


def image_stem(
    in_channels: int,
    out_channels: int,
    *,
    inner: int | None = None,
    norm: Norm = "batch",
    activation: Activation = leaky_relu,
    last_activation: Activation = relu,
) -> nn.Sequential:
    """Two 3x3 convolutions, the first of which halves the size.

    Args:
        in_channels: of the input.
        out_channels: of the output.
        inner: channels between the two; None for those of the output.
        norm: after each of them.
        activation: after the first one.
        last_activation: after the second one.

    Source: CoEx, section "Matching cost computation".

    >>> import torch
    >>> image_stem(3, 8)(torch.rand(1, 3, 6, 10)).shape
    torch.Size([1, 8, 3, 5])
    """
    inner = out_channels if inner is None else inner
    return nn.Sequential(
        ConvNormAct(in_channels, inner, stride=2, norm=norm, activation=activation),
        ConvNormAct(inner, out_channels, norm=norm, activation=last_activation),
    )
