"""The feature extractor of GC-Net: a tower of residual blocks at half resolution."""

from torch import Tensor, nn

from stereokit.contracts import FeatureInfo, Features
from stereokit.layers import ConvNormAct, ResidualBlock, init_convolutions, relu
from stereokit.registry import BACKBONES

__all__ = ["ResidualTower"]


@BACKBONES.register("residual")
class ResidualTower(nn.Module):
    """A strided 5x5 convolution, residual blocks, and a 3x3 convolution without norm.

    Args:
        channels: of every layer.
        blocks: residual blocks.

    Shape: (B, 3, H, W), sides even, to `Features`: matching (B, channels, H/2, W/2), guides {2: channels}.

    Source: Kendall et al., "End-to-end learning of geometry and context for deep stereo regression", ICCV 2017,
    table 1, layers 1 to 18.

    >>> import torch
    >>> ResidualTower().eval()(torch.rand(1, 3, 32, 48)).matching[2].shape
    torch.Size([1, 32, 16, 24])
    """

    multiple = 2

    def __init__(self, *, channels: int = 32, blocks: int = 8) -> None:
        super().__init__()
        self.stem = ConvNormAct(3, channels, 5, stride=2, activation=relu)
        self.blocks = nn.Sequential(*(ResidualBlock(channels, channels, last_activation=relu) for _ in range(blocks)))
        self.head = nn.Conv2d(channels, channels, 3, padding=1, bias=False)
        init_convolutions(self.head)
        self.info = FeatureInfo(matching_channels={2: channels}, guide_channels={2: channels})

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        matching = self.head(self.blocks(self.stem(images)))
        return Features(matching={2: matching}, guides={2: matching})
