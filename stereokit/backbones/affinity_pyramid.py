"""The feature extractor of CSPN's stereo network: pooling and fusion by affinity in place of PSMNet's pyramid."""

import torch
from torch import Tensor, nn

from stereokit.backbones.trunk import ResidualTrunk
from stereokit.contracts import FeatureInfo, Features
from stereokit.layers import AffinityFusion, AffinityPooling, ConvNormAct, init_convolutions, relu
from stereokit.registry import BACKBONES

__all__ = ["AffinityPyramid"]

CELLS = (4, 8, 16, 32)


@BACKBONES.register("affinity_pyramid")
class AffinityPyramid(ResidualTrunk):
    """PSMNet's residual layers, pooled over four sizes of cells by an affinity, and fused by another one (CSPF).

    Two of the layers are joined to `channels` at stride 4 first, as PSMNet does behind its pyramid; where the paper
    pools is not known.

    Args:
        channels: of the matching features.

    Shape: (B, 3, H, W), sides multiples of 4, to `Features`: matching (B, channels, H/4, W/4), guides
    {2: 32, 4: channels}.

    Source: Cheng et al., "Learning depth with convolutional spatial propagation network", TPAMI 2019, "convolutional
    spatial pyramid fusion".

    >>> AffinityPyramid().eval()(torch.rand(1, 3, 64, 96)).matching[4].shape
    torch.Size([1, 32, 16, 24])
    """

    def __init__(self, *, channels: int = 32) -> None:
        super().__init__()
        self.join = nn.Sequential(
            ConvNormAct(64 + 128, 128, activation=relu),
            nn.Conv2d(128, channels, 1, bias=False),
        )
        init_convolutions(self.join)
        self.affinity = ConvNormAct(channels, 1, activation=relu)
        self.branches = nn.ModuleList(AffinityPooling(channels, cell) for cell in CELLS)
        self.fusion = AffinityFusion(channels, len(CELLS))
        self.info = FeatureInfo(matching_channels={4: channels}, guide_channels={2: 32, 4: channels})

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        maps = self.maps(images)
        joined = self.join(torch.cat((maps.layer2, maps.layer4), dim=1))
        affinity = self.affinity(joined)
        pooled = torch.stack([branch(joined, affinity) for branch in self.branches], dim=1)
        matching = self.fusion(pooled, joined)
        return Features(matching={4: matching}, guides={2: maps.stem, 4: matching})
