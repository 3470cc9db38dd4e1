"""The feature extractor of StereoNet: strided convolutions, and residual blocks at the coarse end."""

from functools import partial

from torch import Tensor, nn

from stereokit.contracts import FeatureInfo, Features
from stereokit.errors import ConfigError
from stereokit.layers import ConvNormAct, ResidualBlock, leaky_relu
from stereokit.registry import BACKBONES

__all__ = ["StridedTower"]


@BACKBONES.register("strided")
class StridedTower(nn.Module):
    """Strided 5x5 convolutions in a row with nothing between them, residual blocks, and a 3x3 convolution without norm.

    Args:
        channels: of every layer.
        halvings: K, the number of strided convolutions; the features have stride 2^K.
        blocks: residual blocks.

    Shape: (B, 3, H, W), sides multiples of 2^K, to `Features`: matching (B, channels, H / 2^K, W / 2^K), guides
    {2^K: channels}.

    Raises:
        ConfigError: less than one halving.

    Source: Khamis et al., "StereoNet: guided hierarchical refinement for real-time edge-aware depth prediction",
    ECCV 2018, section 3.1.

    >>> import torch
    >>> StridedTower(halvings=4).eval()(torch.rand(1, 3, 64, 96)).matching[16].shape
    torch.Size([1, 32, 4, 6])
    """

    def __init__(self, *, channels: int = 32, halvings: int = 3, blocks: int = 6) -> None:
        super().__init__()
        if halvings < 1:
            raise ConfigError(f"halvings={halvings!r}: expected at least 1 strided convolution")
        self.multiple = self.stride = 2**halvings
        leaky = partial(leaky_relu, 0.2)
        self.stem = nn.Sequential(
            *(
                ConvNormAct(channels if number else 3, channels, 5, stride=2, bias=True, norm=None, activation=None)
                for number in range(halvings)
            )
        )
        self.blocks = nn.Sequential(
            *(ResidualBlock(channels, channels, activation=leaky, after_sum=leaky) for _ in range(blocks))
        )
        self.head = nn.Conv2d(channels, channels, 3, padding=1)
        self.info = FeatureInfo(matching_channels={self.stride: channels}, guide_channels={self.stride: channels})

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        matching = self.head(self.blocks(self.stem(images)))
        return Features(matching={self.stride: matching}, guides={self.stride: matching})
