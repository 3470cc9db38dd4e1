"""SegStereo: what things are helps to tell how far they are. And ResNetCorr, the same without.

Yang et al., "SegStereo: exploiting semantic information for disparity estimation", ECCV 2018. It has no slots: the last
convolution gives the disparity.
"""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.checks import check_max_disparity
from stereokit.config import IMAGENET_MEAN, IMAGENET_STD, Corner, Padding, Statistics
from stereokit.contracts import Prediction, StereoOutput
from stereokit.costs import groupwise_correlation_volume
from stereokit.layers import ConvNormAct, at_least_float32, cell_means, init_convolutions, relu
from stereokit.network import Preprocessing, StereoNetwork
from stereokit.registry import MODELS

__all__ = ["ResNetCorr", "SegStereo"]

CORRELATED = 8
"""Stride of the maps that are correlated."""


conv = partial(ConvNormAct, activation=relu)


class Bottleneck(nn.Module):
    """1x1, 3x3 and 1x1 convolutions, and a skip.

    Args:
        in_channels: of the input.
        width: of what the first convolution gives.
        out_channels: of the output; where it or the size differs, the skip is a 1x1 convolution with batch norm.
        stride: of the first convolution.
        dilation: of the second.
        middle: of what the second one gives; `width` by default.
    """

    def __init__(
        self,
        in_channels: int,
        width: int,
        out_channels: int,
        *,
        stride: int = 1,
        dilation: int = 1,
        middle: int | None = None,
    ) -> None:
        super().__init__()
        middle = width if middle is None else middle
        self.reduce = conv(in_channels, width, 1, stride=stride)
        self.conv = conv(width, middle, dilation=dilation)
        self.expand = ConvNormAct(middle, out_channels, 1, activation=None)
        self.skip = (
            nn.Identity()
            if stride == 1 and in_channels == out_channels
            else ConvNormAct(in_channels, out_channels, 1, stride=stride, activation=None)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, H, W) to (B, out_channels, H / stride, W / stride), rounded up."""
        return F.relu(self.expand(self.conv(self.reduce(x))) + self.skip(x))


def bottlenecks(in_channels: int, out_channels: int, blocks: int, *, dilation: int = 1) -> nn.Sequential:
    """Bottlenecks in a row, a quarter as wide inside; the first one changes the width."""
    return nn.Sequential(
        *(
            Bottleneck(out_channels if i else in_channels, out_channels // 4, out_channels, dilation=dilation)
            for i in range(blocks)
        )
    )


class Semantics(nn.Module):
    """The rest of a dilated ResNet-50 behind the shared layers, with the means over cells of four sizes added."""

    CELLS = (1, 2, 3, 6)

    def __init__(self) -> None:
        super().__init__()
        self.trunk = nn.Sequential(
            bottlenecks(512, 512, 3), bottlenecks(512, 1024, 6, dilation=2), bottlenecks(1024, 2048, 3, dilation=4)
        )
        self.fuse = conv(2048, 256, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, 512, h, w) to (B, 256, h, w)."""
        x = self.trunk(x)
        pyramid = (
            F.interpolate(cell_means(x, cells), size=x.shape[-2:], mode="bilinear", align_corners=True)
            for cells in self.CELLS
        )
        return self.fuse(sum(pyramid, start=x))


class Regressor(nn.Sequential):
    """A dilated ResNet over the correlation, three doublings, and a convolution that gives the disparity."""

    def __init__(self, in_channels: int) -> None:
        last = nn.Conv2d(32, 1, 3, padding=1)
        init_convolutions(last)
        super().__init__(
            Bottleneck(in_channels, 512, 512, middle=256),
            bottlenecks(512, 512, 2),
            bottlenecks(512, 1024, 6, dilation=2),
            bottlenecks(1024, 2048, 3, dilation=4),
            conv(2048, 512),
            *(doubled(given, given // 2) for given in (512, 256, 128)),
            conv(64, 32),
            last,
        )


def doubled(in_channels: int, out_channels: int) -> nn.Sequential:
    """From n pixels on a side to 2 n - 1, so that the corners stay where they are."""
    up = nn.ConvTranspose2d(in_channels, out_channels, 3, stride=2, padding=1, bias=False)
    init_convolutions(up)
    return nn.Sequential(up, nn.BatchNorm2d(out_channels), relu())


@MODELS.register("segstereo")
class SegStereo(StereoNetwork):
    """Correlation at stride 8, beside an embedding of what a segmentation network sees, regressed by 2D convolutions.

    In the paper the shared layers and the segmentation branch come from a network that was trained on Cityscapes, and
    are frozen; no such weights are here, so that they are trained with the rest. The classifier of the segmentation
    (4,883 weights), and the losses that ask the right view's labels, warped by the disparity, to be the left view's,
    are left out: they need labels.

    The published network compares displacements from 1 to 25 px of its maps, by a slip of its correlation; here they
    are 0 to 24. Its pyramid has windows for images of 1025 x 513 px; here they are those of adaptive pooling, which are
    the same for cells of one, two, and on the longer side three, and a pixel or so apart else.

    There is no distribution over disparities, and so no confidence.

    Args:
        max_disparity: as far as the correlation reaches; a multiple of 8. Estimates may lie beyond.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: a reach that is no multiple of 8, or another preprocessing.

    Source: Yang et al., "SegStereo: exploiting semantic information for disparity estimation", ECCV 2018.

    >>> model = SegStereo(max_disparity=32).eval()
    >>> output = model(*torch.rand(2, 1, 3, 50, 70))
    >>> output.disparity.shape, output.confidence
    (torch.Size([1, 50, 70]), None)
    """

    semantic = True

    def __init__(
        self,
        *,
        max_disparity: int = 192,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        statistics: Statistics = "fixed",
        padding: Padding = "replicate",
        corner: Corner = "bottom_right",
    ) -> None:
        check_max_disparity(max_disparity, CORRELATED, f"maps of stride {CORRELATED}")
        super().__init__(
            max_disparity=max_disparity,
            multiple=CORRELATED,
            preprocessing=Preprocessing(mean=mean, std=std, statistics=statistics, padding=padding, corner=corner),
        )
        self.displacements = max_disparity // CORRELATED + 1
        self.shallow = nn.Sequential(
            conv(3, 64, stride=2),
            conv(64, 64),
            conv(64, 128),
            nn.MaxPool2d(3, stride=2, padding=1),
            bottlenecks(128, 256, 3),
            Bottleneck(256, 128, 512, stride=2),
        )
        self.matching = conv(512, 256)
        self.transform = conv(256, 256, 1)
        if self.semantic:
            self.semantics = Semantics()
            self.embedding = conv(256, 128, 1)
        self.regressor = Regressor(256 + self.displacements + (128 if self.semantic else 0))

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Images, normalised and padded, to the output."""
        # of 8 n + 1 pixels, the corners of all maps lie on each other
        height, width = left.shape[-2:]
        shallow = self.shallow(F.pad(torch.cat((left, right)), (0, 1, 0, 1), mode="replicate"))
        matched, of_right = self.matching(shallow).chunk(2)
        correlation = groupwise_correlation_volume(matched, of_right, self.displacements, 1).squeeze(1)
        maps = [self.transform(matched), correlation]
        if self.semantic:
            maps.append(self.embedding(self.semantics(shallow.chunk(2)[0])))
        raw = at_least_float32(self.regressor(torch.cat(maps, dim=1)))[:, 0, :height, :width]
        # to 0 where it is below, but for the loss, for which such a pixel would have no gradient
        return StereoOutput(F.relu(raw), (Prediction(raw),))


@MODELS.register("resnetcorr")
class ResNetCorr(SegStereo):
    """SegStereo without semantics: a dilated ResNet over a correlation that reaches further.

    Args:
        max_disparity: as far as the correlation reaches; a multiple of 8. Estimates may lie beyond.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: a reach that is no multiple of 8, or another preprocessing.

    Source: Yang et al., "SegStereo: exploiting semantic information for disparity estimation", ECCV 2018.

    >>> ResNetCorr(max_disparity=32).eval()(*torch.rand(2, 1, 3, 50, 70)).disparity.shape
    torch.Size([1, 50, 70])
    """

    semantic = False

    def __init__(
        self,
        *,
        max_disparity: int = 256,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        statistics: Statistics = "fixed",
        padding: Padding = "replicate",
        corner: Corner = "bottom_right",
    ) -> None:
        super().__init__(
            max_disparity=max_disparity, mean=mean, std=std, statistics=statistics, padding=padding, corner=corner
        )
