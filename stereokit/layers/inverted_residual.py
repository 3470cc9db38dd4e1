"""The inverted residual block of MobileNetV2."""

from typing import Literal

from torch import Tensor, nn

from stereokit.layers.convolution import ConvNormAct, named_activation

__all__ = ["InvertedResidual"]


class InvertedResidual(nn.Module):
    """Widen by a 1x1 convolution, convolve each channel by itself, narrow; the input is added where it fits.

    Args:
        in_channels: of the input.
        out_channels: of the output.
        stride: of the depth-wise convolution.
        expansion: by which the inner width is larger than `in_channels`.
        dims: 2 for maps, 3 for volumes.
        residual: add the input, where neither size nor width change.

    Source: Sandler et al., "MobileNetV2: inverted residuals and linear bottlenecks", CVPR 2018, table 1.

    >>> import torch
    >>> InvertedResidual(8, 16, stride=2)(torch.rand(1, 8, 5, 6)).shape
    torch.Size([1, 16, 3, 3])
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        stride: int = 1,
        expansion: int = 4,
        dims: Literal[2, 3] = 2,
        residual: bool = True,
    ) -> None:
        super().__init__()
        inner, relu6 = expansion * in_channels, named_activation("relu6")
        self.widen = ConvNormAct(in_channels, inner, 1, dims=dims, activation=relu6)
        self.depthwise = ConvNormAct(inner, inner, dims=dims, stride=stride, groups=inner, activation=relu6)
        self.narrow = ConvNormAct(inner, out_channels, 1, dims=dims, activation=None)
        self.adds_input = residual and stride == 1 and in_channels == out_channels

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, (D,) H, W) to (B, out_channels, (D / stride,) H / stride, W / stride)."""
        y: Tensor = self.narrow(self.depthwise(self.widen(x)))
        return x + y if self.adds_input else y
