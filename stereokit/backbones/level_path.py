"""The feature extractor of LEAStereo: three convolutions, and searched cells at two scales."""

from collections.abc import Sequence

from torch import Tensor, nn

from stereokit.contracts import FeatureInfo, Features
from stereokit.layers import CellNodes, ConvNormAct, LevelPath, init_convolutions, level_size, relu, resize
from stereokit.registry import BACKBONES

__all__ = ["LevelPathBackbone"]

NODES: CellNodes = (
    (("s0", "conv"), ("s1", "skip")),
    (("s1", "conv"), ("n0", "conv")),
    (("s0", "conv"), ("n1", "conv")),
)
"""That the search for features found."""


@BACKBONES.register("level_path")
class LevelPathBackbone(nn.Module):
    """Three convolutions down to stride 3, a path of searched cells, and a 1x1 convolution.

    Args:
        levels: of the cells: stride 3, 6, 12, ... for 0, 1, 2, ...
        nodes: of every cell, see `SearchedCell`.
        filters: width of a cell's nodes at level 0; the features have four times that.

    Shape: (B, 3, H, W), sides multiples of 3, to `Features`: matching (B, 4 * filters, H/3, W/3), guides
    {1: 2 * filters, 3: 4 * filters}.

    Raises:
        ConfigError: levels or nodes that make no path.

    Source: Cheng et al., "Hierarchical neural architecture search for deep stereo matching", NeurIPS 2020, figure 5.

    >>> import torch
    >>> LevelPathBackbone().eval()(torch.rand(1, 3, 48, 72)).matching[3].shape
    torch.Size([1, 32, 16, 24])
    """

    multiple = 3

    def __init__(
        self, *, levels: Sequence[int] = (1, 0, 1, 0, 0, 0), nodes: CellNodes = NODES, filters: int = 8
    ) -> None:
        super().__init__()
        channels = 4 * filters
        self.stem0 = ConvNormAct(3, 2 * filters, activation=relu)
        self.stem1 = ConvNormAct(2 * filters, channels, stride=3, activation=relu)
        self.stem2 = ConvNormAct(channels, channels, activation=relu)
        self.path = LevelPath(levels, nodes, dims=2, channels=(channels, channels), filters=filters)
        self.ladder = nn.ModuleList(
            ConvNormAct(channels * 2**level, channels * 2 ** (level - 1), 1, activation=relu)
            for level in range(levels[-1], 0, -1)
        )
        self.head = nn.Conv2d(channels, channels, 1, bias=False)
        init_convolutions(self.head)
        self.info = FeatureInfo(matching_channels={3: channels}, guide_channels={1: 2 * filters, 3: channels})

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        full = self.stem0(images)
        before = self.stem1(full)
        last = self.stem2(before)
        x = self.path(before, last)
        for step, conv in enumerate(self.ladder, start=1):
            x = resize(conv(x), level_size(last.shape[2:], len(self.ladder) - step))
        matching = self.head(x)
        return Features(matching={3: matching}, guides={1: full, 3: matching})
