"""The feature extractor of GwcNet: the last three residual layers side by side."""

import torch
from torch import Tensor

from stereokit.backbones.trunk import ResidualTrunk
from stereokit.contracts import FeatureInfo, Features
from stereokit.registry import BACKBONES

__all__ = ["GwcTrunk"]


@BACKBONES.register("gwc_trunk")
class GwcTrunk(ResidualTrunk):
    """PSMNet's residual layers without its pyramid; those at stride 4 are concatenated.

    The maps are sums without a norm, so their scale is free. Those at stride 2, of the first layer, are there for
    networks that end with a finer stage.

    Args:
        full_size: see `ResidualTrunk`; then there are guides at stride 1 too.

    Shape: (B, 3, H, W), sides multiples of 4, to `Features`: matching and guides (B, 320, H/4, W/4) and
    (B, 32, H/2, W/2); a guide (B, 32, H, W).

    Source: Guo et al., "Group-wise correlation stereo network", CVPR 2019, section 3.1.

    >>> {s: m.shape[1] for s, m in GwcTrunk().eval()(torch.rand(1, 3, 64, 96)).matching.items()}
    {2: 32, 4: 320}
    """

    def __init__(self, *, full_size: bool = False) -> None:
        super().__init__(full_size=full_size)
        matching = {2: 32, 4: 320}
        self.info = FeatureInfo(
            matching_channels=matching, guide_channels={1: 32, **matching} if full_size else matching
        )

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        maps = self.maps(images)
        matching = {2: maps.layer1, 4: torch.cat((maps.layer2, maps.layer3, maps.layer4), dim=1)}
        return Features(matching=matching, guides={1: maps.first, **matching} if self.full_size else matching)
