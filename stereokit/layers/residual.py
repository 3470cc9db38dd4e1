"""Residual blocks of 2D convolutions."""

from functools import partial

from torch import Tensor, nn

from stereokit.layers.convolution import Activation, ConvNormAct, Norm, relu

__all__ = ["ResidualBlock", "residual_layer"]


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
    ) -> None:
        super().__init__()
        conv = partial(ConvNormAct, norm=norm, bias=bias)
        self.conv1 = conv(in_channels, out_channels, stride=stride, dilation=dilation, activation=activation)
        self.conv2 = conv(out_channels, out_channels, dilation=dilation, activation=last_activation)
        self.skip = (
            nn.Identity()
            if stride == 1 and in_channels == out_channels
            else conv(in_channels, out_channels, 1, stride=stride, activation=None)
        )
        self.after_sum = nn.Identity() if after_sum is None else after_sum()

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, H, W) to (B, out_channels, H / stride, W / stride)."""
        return self.after_sum(self.conv2(self.conv1(x)) + self.skip(x))


def residual_layer(
    in_channels: int, out_channels: int, blocks: int, *, stride: int = 1, dilation: int = 1
) -> nn.Sequential:
    """Residual blocks in a row; the first one changes size and width.

    >>> import torch
    >>> residual_layer(8, 16, 3, stride=2)(torch.rand(1, 8, 6, 10)).shape
    torch.Size([1, 16, 3, 5])
    """
    first = ResidualBlock(in_channels, out_channels, stride=stride, dilation=dilation)
    return nn.Sequential(
        first, *(ResidualBlock(out_channels, out_channels, dilation=dilation) for _ in range(blocks - 1))
    )
