"""The feature extractor of PSMNet: residual layers and spatial pyramid pooling."""

from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import FeatureInfo, Features
from stereokit.layers import ConvNormAct, ResidualBlock, init_convolutions, relu
from stereokit.registry import BACKBONES

__all__ = ["SpatialPyramid"]


def residual_layer(
    in_channels: int, out_channels: int, blocks: int, *, stride: int = 1, dilation: int = 1
) -> nn.Sequential:
    """Residual blocks in a row; the first one changes size and width."""
    first = ResidualBlock(in_channels, out_channels, stride=stride, dilation=dilation)
    return nn.Sequential(
        first, *(ResidualBlock(out_channels, out_channels, dilation=dilation) for _ in range(blocks - 1))
    )


class PooledBranch(nn.Module):
    """One scale of the pyramid: average pooling, a 1x1 convolution, and back to the size of the input."""

    def __init__(self, in_channels: int, out_channels: int, pool: int) -> None:
        super().__init__()
        self.pool = pool
        self.conv = ConvNormAct(in_channels, out_channels, 1, activation=relu)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to (B, out_channels, H, W); a map smaller than the pool is pooled whole."""
        height, width = x.shape[-2:]
        # zeros fill a smaller map up to one window and are then left out of the mean; the window stays a constant,
        # so that torch.export can keep height and width open
        bottom, right = (torch.sym_max(self.pool - size, 0) for size in (height, width))
        pooled = F.avg_pool2d(F.pad(x, [0, cast(int, right), 0, cast(int, bottom)]), self.pool)
        share_inside = (self.pool - bottom) * (self.pool - right) / self.pool**2
        pooled = self.conv(pooled * (1 / share_inside))
        return F.interpolate(pooled, size=(height, width), mode="bilinear", align_corners=False)


@BACKBONES.register("spatial_pyramid")
class SpatialPyramid(nn.Module):
    """Residual layers at stride 4, two of them dilated, and average pooling over four window sizes.

    Args:
        channels: of the matching features.

    Shape: (B, 3, H, W), sides multiples of 4, to `Features`: matching (B, channels, H/4, W/4), guides
    {2: 32, 4: channels}.

    Source: Chang and Chen, "Pyramid Stereo Matching Network", CVPR 2018, section 3.2 and table 1.

    >>> SpatialPyramid().eval()(torch.rand(1, 3, 64, 96)).matching[4].shape
    torch.Size([1, 32, 16, 24])
    """

    multiple = 4

    def __init__(self, *, channels: int = 32) -> None:
        super().__init__()
        self.stem = nn.Sequential(
            ConvNormAct(3, 32, stride=2, activation=relu),
            ConvNormAct(32, 32, activation=relu),
            ConvNormAct(32, 32, activation=relu),
        )
        self.layer1 = residual_layer(32, 32, 3)
        self.layer2 = residual_layer(32, 64, 16, stride=2)
        self.layer3 = residual_layer(64, 128, 3)
        self.layer4 = residual_layer(128, 128, 3, dilation=2)
        self.branches = nn.ModuleList([PooledBranch(128, 32, pool) for pool in (8, 16, 32, 64)])
        self.fuse = nn.Sequential(
            ConvNormAct(64 + 128 + 4 * 32, 128, activation=relu), nn.Conv2d(128, channels, 1, bias=False)
        )
        init_convolutions(self.fuse)
        self.info = FeatureInfo(matching_channels={4: channels}, guide_channels={2: 32, 4: channels})

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        stem = self.stem(images)
        raw = self.layer2(self.layer1(stem))
        skip = self.layer4(self.layer3(raw))
        pyramid = torch.cat((raw, skip, *(branch(skip) for branch in self.branches)), dim=1)
        matching = self.fuse(pyramid)
        return Features(matching={4: matching}, guides={2: stem, 4: matching})
