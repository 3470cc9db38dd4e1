"""The feature extractor of MobileStereoNet: GwcNet's, of separable convolutions."""

import torch
from torch import Tensor, nn

from stereokit.backbones.trunk import ResidualTrunk
from stereokit.contracts import FeatureInfo, Features
from stereokit.layers import InvertedResidual, SeparableBlock, relu
from stereokit.registry import BACKBONES

__all__ = ["SeparableTrunk"]


@BACKBONES.register("separable_trunk")
class SeparableTrunk(ResidualTrunk):
    """Residual layers as in `GwcTrunk`, with inverted residuals as stem, and separable convolutions after it.

    Args:
        stem_activation: a ReLU after each of the three blocks of the stem.

    Shape: (B, 3, H, W), sides multiples of 4, to `Features`: matching and guides (B, 320, H/4, W/4) and
    (B, 32, H/2, W/2).

    Source: Shamsafar et al., "MobileStereoNet: towards lightweight deep networks for stereo matching", WACV 2022,
    section 3.

    >>> {s: m.shape[1] for s, m in SeparableTrunk().eval()(torch.rand(1, 3, 64, 96)).matching.items()}
    {2: 32, 4: 320}
    """

    def __init__(self, *, stem_activation: bool = True) -> None:
        activation = [relu()] if stem_activation else []
        stem = (
            nn.Sequential(InvertedResidual(32 if i else 3, 32, stride=1 if i else 2, expansion=3), *activation)
            for i in range(3)
        )
        super().__init__(stem=nn.Sequential(*stem), block=SeparableBlock)
        channels = {2: 32, 4: 320}
        self.info = FeatureInfo(matching_channels=channels, guide_channels=channels)

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        maps = self.maps(images)
        matching = {2: maps.layer1, 4: torch.cat((maps.layer2, maps.layer3, maps.layer4), dim=1)}
        return Features(matching=matching, guides=matching)
