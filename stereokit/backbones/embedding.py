"""The feature extractor of PDS-Net: four layers without pooling."""

from torch import Tensor, nn

from stereokit.contracts import FeatureInfo, Features
from stereokit.layers import ActNormResidual, conv_act_norm
from stereokit.registry import BACKBONES

__all__ = ["Embedding"]


@BACKBONES.register("embedding")
class Embedding(nn.Module):
    """Two 5x5 convolutions that halve the size, and two residual blocks, with instance norms after the activations.

    Args:
        channels: of all layers.

    Shape: (B, 3, H, W), sides multiples of 4, to `Features`: matching and guides {4: (B, channels, H/4, W/4)}.

    Source: Tulyakov et al., "Practical Deep Stereo (PDS): toward applications-friendly deep stereo matching",
    NeurIPS 2018, "Embedding".

    >>> import torch
    >>> Embedding()(torch.rand(1, 3, 32, 48)).matching[4].shape
    torch.Size([1, 64, 8, 12])
    """

    multiple = 4

    def __init__(self, *, channels: int = 64) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            conv_act_norm(3, channels, 5, stride=2),
            conv_act_norm(channels, channels, 5, stride=2),
            ActNormResidual(channels),
            ActNormResidual(channels),
        )
        self.info = FeatureInfo(matching_channels={4: channels}, guide_channels={4: channels})

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        maps = {4: self.layers(images)}
        return Features(matching=maps, guides=maps)
