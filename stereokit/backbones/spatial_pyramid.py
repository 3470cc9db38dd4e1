"""The feature extractor of PSMNet: residual layers and spatial pyramid pooling."""

from functools import partial
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.backbones.trunk import ResidualTrunk
from stereokit.contracts import FeatureInfo, Features
from stereokit.layers import ConvNormAct, ResidualBlock, init_convolutions, relu
from stereokit.registry import BACKBONES

__all__ = ["SpatialPyramid"]


class PooledBranch(nn.Module):
    """One scale of the pyramid: average pooling, a 1x1 convolution, and back to the size of the input."""

    def __init__(self, in_channels: int, out_channels: int, pool: int, *, align_corners: bool = False) -> None:
        super().__init__()
        self.pool = pool
        self.align_corners = align_corners
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
        return F.interpolate(pooled, size=(height, width), mode="bilinear", align_corners=self.align_corners)


@BACKBONES.register("spatial_pyramid")
class SpatialPyramid(ResidualTrunk):
    """Residual layers at stride 4, two of them dilated, and average pooling over four window sizes.

    Args:
        channels: of the matching features.
        bias: of the last convolution.
        full_size: see `ResidualTrunk`; then there are guides at stride 1 too, and those at 2 are deeper.
        deep_guides: the guides at stride 2 come from behind the first residual layers, in place of ahead of them.
        halvings: 3 for stride 8, without dilation and the largest window, as in DeepPruner's fast form; then there are
            guides at stride 8 too.
        align_corners: of the interpolation that brings the pooled maps back, as in AcfNet.
        skip_bias: a bias in the 1x1 convolutions beside residual blocks, ahead of their norms; likewise.

    Shape: (B, 3, H, W), sides multiples of 4, to `Features`: matching (B, channels, H/4, W/4), guides
    {2: 32, 4: channels}.

    Raises:
        ConfigError: another number of halvings.

    Source: Chang and Chen, "Pyramid Stereo Matching Network", CVPR 2018, section 3.2 and table 1.

    >>> SpatialPyramid().eval()(torch.rand(1, 3, 64, 96)).matching[4].shape
    torch.Size([1, 32, 16, 24])
    """

    def __init__(
        self,
        *,
        channels: int = 32,
        bias: bool = False,
        full_size: bool = False,
        deep_guides: bool = False,
        halvings: int = 2,
        align_corners: bool = False,
        skip_bias: bool = False,
    ) -> None:
        block = partial(ResidualBlock, skip_bias=skip_bias)
        super().__init__(full_size=full_size, halvings=halvings, block=block)
        self.deep_guides = deep_guides or full_size
        self.branches = nn.ModuleList(
            [PooledBranch(128, 32, pool, align_corners=align_corners) for pool in (8, 16, 32, 64)[: 6 - halvings]]
        )
        beside = 64 if halvings == 2 else 128
        self.fuse = nn.Sequential(
            ConvNormAct(beside + 128 + 32 * len(self.branches), 128, activation=relu),
            nn.Conv2d(128, channels, 1, bias=bias),
        )
        init_convolutions(self.fuse)
        guides = {2: 32, 4: channels} if halvings == 2 else {2: 32, 4: 64, 8: channels}
        self.info = FeatureInfo(
            matching_channels={self.multiple: channels}, guide_channels={1: 32, **guides} if full_size else guides
        )

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        maps = self.maps(images)
        pooled = (branch(maps.layer4) for branch in self.branches)
        beside = maps.layer2 if self.multiple == 4 else maps.layer3
        matching = self.fuse(torch.cat((beside, maps.layer4, *pooled), dim=1))
        guides = {2: maps.layer1 if self.deep_guides else maps.stem}
        if self.full_size:
            guides[1] = maps.first
        if self.multiple == 8:
            guides[4] = maps.layer2
        return Features(matching={self.multiple: matching}, guides={**guides, self.multiple: matching})
