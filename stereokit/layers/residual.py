"""Residual blocks of 2D convolutions."""

from collections.abc import Callable
from functools import partial

from torch import Tensor, nn

from stereokit.layers.convolution import Activation, ConvNormAct, Norm, named_activation, relu

__all__ = ["ResidualBlock", "SeparableBlock", "residual_layer"]


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions and a skip.

    Args:
        in_channels: of the input.
        out_channels: of the output; where it or the size differs, the skip is a 1x1 convolution with batch norm.
        stride: of the first convolution.
        dilation: of both.
        activation: of the first convolution.
        last_activation: of the second convolution, before the sum.
        after_sum: activation after the sum; None for none.
        norm: of all convolutions.
        bias: likewise.
        skip_bias: of the skip's convolution; None for `bias`.
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        stride: int = 1,
        dilation: int = 1,
        activation: Activation = relu,
        last_activation: Activation | None = None,
        after_sum: Activation | None = None,
        norm: Norm = "batch",
        bias: bool = False,
        skip_bias: bool | None = None,
    ) -> None:
        super().__init__()
        conv = partial(ConvNormAct, norm=norm, bias=bias)
        self.conv1 = conv(in_channels, out_channels, stride=stride, dilation=dilation, activation=activation)
        self.conv2 = conv(out_channels, out_channels, dilation=dilation, activation=last_activation)
        self.skip = (
            nn.Identity()
            if stride == 1 and in_channels == out_channels
            else conv(
                in_channels,
                out_channels,
                1,
                stride=stride,
                bias=bias if skip_bias is None else skip_bias,
                activation=None,
            )
        )
        self.after_sum = nn.Identity() if after_sum is None else after_sum()

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, H, W) to (B, out_channels, H / stride, W / stride)."""
        return self.after_sum(self.conv2(self.conv1(x)) + self.skip(x))


class SeparableBlock(nn.Module):
    """A residual block whose 3x3 convolutions see each channel by itself, and are followed by 1x1 ones.

    Args:
        in_channels: of the input.
        out_channels: of the output; where it or the size differs, the skip is a 1x1 convolution with batch norm.
        stride: of the first convolution.
        dilation: of both.

    Source: Shamsafar et al., "MobileStereoNet: towards lightweight deep networks for stereo matching", WACV 2022,
    "MobileNet-V1 block"; Howard et al., "MobileNets", 2017.

    >>> import torch
    >>> SeparableBlock(8, 16, stride=2)(torch.rand(1, 8, 6, 10)).shape
    torch.Size([1, 16, 3, 5])
    """

    def __init__(self, in_channels: int, out_channels: int, *, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        relu6 = named_activation("relu6")

        def separable(width: int, stride: int, last: Activation | None) -> nn.Sequential:
            return nn.Sequential(
                ConvNormAct(width, width, stride=stride, dilation=dilation, groups=width, activation=relu6),
                ConvNormAct(width, out_channels, 1, activation=last),
            )

        self.conv1 = separable(in_channels, stride, relu6)
        self.conv2 = separable(out_channels, 1, None)
        self.skip = (
            nn.Identity()
            if stride == 1 and in_channels == out_channels
            else ConvNormAct(in_channels, out_channels, 1, stride=stride, activation=None)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, H, W) to (B, out_channels, H / stride, W / stride)."""
        return self.conv2(self.conv1(x)) + self.skip(x)


def residual_layer(
    in_channels: int,
    out_channels: int,
    blocks: int,
    *,
    stride: int = 1,
    dilation: int = 1,
    block: Callable[..., ResidualBlock | SeparableBlock] = ResidualBlock,
) -> nn.Sequential:
    """Residual blocks in a row; the first one changes size and width.

    >>> import torch
    >>> residual_layer(8, 16, 3, stride=2)(torch.rand(1, 8, 6, 10)).shape
    torch.Size([1, 16, 3, 5])
    """
    first = block(in_channels, out_channels, stride=stride, dilation=dilation)
    return nn.Sequential(first, *(block(out_channels, out_channels, dilation=dilation) for _ in range(blocks - 1)))
