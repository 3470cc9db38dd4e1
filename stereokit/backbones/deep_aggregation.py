"""The feature extractor of HD3: DLA-34, and maps that are aggregated upwards again and again."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from stereokit.backbones.encoder import create_timm_model
from stereokit.contracts import FeatureInfo, Features
from stereokit.errors import ConfigError
from stereokit.layers import ConvNormAct, init_convolutions, relu
from stereokit.registry import BACKBONES

__all__ = ["DeepAggregation", "UpAggregation"]

COARSEST = 64


class UpAggregation(nn.Module):
    """Maps of which all but the first are half as fine as it, merged into it one after the other.

    Args:
        in_channels: of the maps.

    Shape: (B, C, h, w) and maps (B, ., h / 2, w / 2) to as many maps (B, C, h, w) as the latter are.

    Source: Yu et al., "Deep layer aggregation", CVPR 2018, section 3.1: iterative deep aggregation.

    >>> merged = UpAggregation((4, 6, 8))([torch.rand(1, 4, 6, 8), torch.rand(1, 6, 3, 4), torch.rand(1, 8, 3, 4)])
    >>> [tuple(x.shape) for x in merged]
    [(1, 4, 6, 8), (1, 4, 6, 8)]
    """

    def __init__(self, in_channels: Sequence[int]) -> None:
        super().__init__()
        width, *coarse = in_channels
        self.project = nn.ModuleList(
            nn.Identity() if channels == width else ConvNormAct(channels, width, 1, activation=relu)
            for channels in coarse
        )
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(width, width, 4, stride=2, padding=1, groups=width, bias=False) for _ in coarse
        )
        self.merge = nn.ModuleList(ConvNormAct(2 * width, width, activation=relu) for _ in coarse)
        init_convolutions(self.up)

    def forward(self, maps: Sequence[Tensor]) -> list[Tensor]:
        """What each merge gives, the last one of all maps."""
        x, *coarse = maps
        merged = []
        for given, project, up, merge in zip(coarse, self.project, self.up, self.merge, strict=True):
            x = merge(torch.cat((x, up(project(given))), dim=1))
            merged.append(x)
        return merged


@BACKBONES.register("deep_aggregation")
class DeepAggregation(nn.Module):
    """DLA-34 with a further halving, and iterative aggregation from its coarse maps to its fine ones.

    The maps of all strides are matching features and guides alike.

    Args:
        channels: of DLA's levels at strides 1, 2, 4, 8, 16, 32 and 64; those from 2 on are those of the maps.
        finest: stride of the finest map, a power of two from 2 to 32.
        pretrained: load timm's weights for DLA-34, which the coarsest level is not part of.

    Shape: (B, 3, H, W), sides multiples of 64, to `Features` at strides `finest` to 64; by default of 32, 64, 128, 256,
    512 and 512 channels.

    Raises:
        ConfigError: another number of levels, another stride, or weights for other channels.

    Source: Yin et al., "Hierarchical discrete distribution decomposition for match density estimation", CVPR 2019,
    section 4; Yu et al., "Deep layer aggregation", CVPR 2018.

    >>> DeepAggregation(channels=(4, 4, 4, 6, 6, 8, 8)).eval()(torch.rand(1, 3, 64, 128)).matching[4].shape
    torch.Size([1, 4, 16, 32])
    """

    multiple = COARSEST

    def __init__(
        self,
        *,
        channels: Sequence[int] = (16, 32, 64, 128, 256, 512, 512),
        finest: int = 2,
        pretrained: bool = False,
    ) -> None:
        super().__init__()
        if len(channels) != 7:
            raise ConfigError(f"channels={tuple(channels)!r}: give seven, of the strides from 1 to 64")
        widths = dict(zip((2, 4, 8, 16, 32, 64), channels[1:], strict=True))
        if finest not in widths or finest == COARSEST:
            raise ConfigError(f"finest={finest!r} is no stride of the maps; use 2, 4, 8, 16 or 32")
        dla = create_timm_model("dla34", pretrained=pretrained, num_classes=0, channels=tuple(channels[:6]))
        self.stem = nn.Sequential(dla.base_layer, dla.level0)
        self.levels = nn.ModuleList((dla.level1, dla.level2, dla.level3, dla.level4, dla.level5))
        self.levels.append(_further_halving(channels[5], channels[6]))
        self.strides = tuple(stride for stride in widths if stride >= finest)
        fine_to_coarse = [widths[stride] for stride in self.strides]
        self.aggregations = nn.ModuleList(
            # the coarse maps of the first one are as they came, those of the others of the width before
            UpAggregation((fine, *([coarse] * (count + 1))))
            for count, (coarse, fine) in enumerate(pairwise(reversed(fine_to_coarse)))
        )
        self.info = FeatureInfo(
            matching_channels={stride: widths[stride] for stride in self.strides},
            guide_channels={stride: widths[stride] for stride in self.strides},
        )

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        x = self.stem(images)
        maps = []
        for level in self.levels:
            x = level(x)
            maps.append(x)
        maps = maps[-len(self.strides) :]
        aggregated = [maps[-1]]
        for count, aggregation in enumerate(self.aggregations):
            # what was merged takes the place of what it was merged from
            merged = aggregation(maps[-count - 2 :])
            maps[-count - 1 :] = merged
            aggregated.append(merged[-1])
        by_stride = dict(zip(self.strides, reversed(aggregated), strict=True))
        return Features(matching=by_stride, guides=by_stride)


def _further_halving(in_channels: int, out_channels: int) -> nn.Module:
    """A tree of depth 1, as DLA's own."""
    from timm.models.dla import DlaBasic, DlaTree

    tree = DlaTree(1, DlaBasic, in_channels, out_channels, 2, level_root=True)
    init_convolutions(tree)
    return tree
