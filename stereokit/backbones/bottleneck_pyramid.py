"""The feature extractor of AANet: bottlenecks at strides 3 to 12, and a feature pyramid on them."""

from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import FeatureInfo, Features
from stereokit.errors import ConfigError
from stereokit.layers import Bottleneck, ConvNormAct, relu
from stereokit.registry import BACKBONES

__all__ = ["BottleneckPyramid"]

WIDTHS = (32, 64, 128)
"""Of the bottlenecks, at strides 3, 6 and 12; they give four times as many channels."""

STRIDES = (3, 6, 12)


@BACKBONES.register("bottleneck_pyramid")
class BottleneckPyramid(nn.Module):
    """A convolution of stride 3, bottlenecks at three scales, and a top-down pathway; matching maps at all three.

    Args:
        channels: of the maps.
        blocks: bottlenecks at each scale.
        deformable: whether those at the coarsest scale have deformable convolutions.
        scales: of which there are maps, from the finest: 1 for networks that compare at one scale.

    Shape: (B, 3, H, W), sides multiples of 12, to `Features`: matching and guides {3, 6, 12: channels}.

    Raises:
        ConfigError: no such number of scales.

    Source: Xu and Zhang, "AANet: adaptive aggregation network for efficient stereo matching", CVPR 2020, section 3.4;
    the pathway is that of Lin et al., "Feature pyramid networks for object detection", CVPR 2017.

    >>> import torch
    >>> maps = BottleneckPyramid(channels=16, blocks=(1, 1, 1)).eval()(torch.rand(1, 3, 24, 36)).matching
    >>> {stride: tuple(x.shape) for stride, x in maps.items()}
    {3: (1, 16, 8, 12), 6: (1, 16, 4, 6), 12: (1, 16, 2, 3)}
    """

    multiple = 12

    def __init__(
        self,
        *,
        channels: int = 128,
        blocks: tuple[int, int, int] = (3, 4, 6),
        deformable: bool = True,
        scales: int = 3,
    ) -> None:
        super().__init__()
        if scales not in (1, 2, 3):
            raise ConfigError(f"scales={scales!r}: a bottleneck pyramid gives maps of 1, 2 or 3 scales")
        self.stem = ConvNormAct(3, 32, 7, stride=3, activation=relu)
        given, layers = 32, []
        for scale, (width, count) in enumerate(zip(WIDTHS, blocks, strict=True)):
            bent = deformable and scale == len(WIDTHS) - 1
            first = Bottleneck(given, width, 4 * width, stride=2 if scale else 1, deformable=bent)
            given = 4 * width
            layers.append(
                nn.Sequential(first, *(Bottleneck(given, width, given, deformable=bent) for _ in range(count - 1)))
            )
        self.layers = nn.ModuleList(layers)
        self.laterals = nn.ModuleList(nn.Conv2d(4 * width, channels, 1) for width in WIDTHS)
        self.heads = nn.ModuleList(ConvNormAct(channels, channels, bias=True, activation=relu) for _ in range(scales))
        widths = dict.fromkeys(STRIDES[:scales], channels)
        self.info = FeatureInfo(matching_channels=widths, guide_channels=widths)

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        x, maps = self.stem(images), []
        for layer, lateral in zip(self.layers, self.laterals, strict=True):
            x = layer(x)
            maps.append(lateral(x))
        for scale in (1, 0):
            maps[scale] = maps[scale] + F.interpolate(maps[scale + 1], scale_factor=2, mode="nearest")
        matching = {stride: head(x) for stride, head, x in zip(STRIDES, self.heads, maps, strict=False)}
        return Features(matching=matching, guides=matching)
