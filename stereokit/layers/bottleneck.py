"""The bottleneck of ResNet."""

from torch import Tensor, nn

from stereokit.layers.convolution import ConvNormAct, relu
from stereokit.layers.deformable import DeformableConvolution

__all__ = ["Bottleneck"]


class Bottleneck(nn.Module):
    """Convolutions of 1x1, 3x3 and 1x1 and a skip, with an activation after the sum.

    Args:
        in_channels: of the input.
        width: of the 3x3 convolution.
        out_channels: of the output; where it or the size differs, the skip is a 1x1 convolution with batch norm.
        stride: of the 3x3 convolution.
        deformable: whether that one is a `DeformableConvolution`.

    Source: He et al., "Deep residual learning for image recognition", CVPR 2016, figure 5.

    >>> import torch
    >>> Bottleneck(8, 4, 16, stride=2)(torch.rand(1, 8, 6, 10)).shape
    torch.Size([1, 16, 3, 5])
    """

    def __init__(
        self, in_channels: int, width: int, out_channels: int, *, stride: int = 1, deformable: bool = False
    ) -> None:
        super().__init__()
        self.conv1 = ConvNormAct(in_channels, width, 1, activation=relu)
        self.conv2: nn.Module = (
            nn.Sequential(DeformableConvolution(width, width, stride=stride), nn.BatchNorm2d(width), relu())
            if deformable
            else ConvNormAct(width, width, stride=stride, activation=relu)
        )
        self.conv3 = ConvNormAct(width, out_channels, 1, activation=None)
        self.skip = (
            nn.Identity()
            if stride == 1 and in_channels == out_channels
            else ConvNormAct(in_channels, out_channels, 1, stride=stride, activation=None)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, H, W) to (B, out_channels, H / stride, W / stride)."""
        return (self.conv3(self.conv2(self.conv1(x))) + self.skip(x)).relu()
