"""CRL: a first disparity of full size, and a second network that adds to it what is left, scale by scale.

Pang et al., "Cascade residual learning: a two-stage convolutional neural network for stereo matching", ICCV workshops
2017. It has no slots: convolutions give the disparity.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.checks import check_max_disparity
from stereokit.config import IMAGENET_MEAN, IMAGENET_STD, Corner, Padding, Statistics
from stereokit.contracts import Prediction, StereoOutput
from stereokit.costs.signed_correlation import SignedCorrelation
from stereokit.layers import at_least_float32, tent_means, warp
from stereokit.models.dispnetc import BOTTOM, CORRELATED, SKIPS, Encoder, Features, UpLevel, conv
from stereokit.network import Preprocessing, StereoNetwork
from stereokit.registry import MODELS

__all__ = ["CRL", "DispFulNet", "DispResNet"]


class Estimates(NamedTuple):
    """What a stage says, from coarse to fine."""

    raw: list[Tensor]
    """(B, 1, h, w) each, in px, as predicted: for the loss."""

    @property
    def disparity(self) -> Tensor:
        """The finest, never negative, (B, 1, h, w)."""
        return F.relu(self.raw[-1])


class DispFulNet(nn.Module):
    """The first stage: DispNetC, carried on to full size.

    Args:
        max_disparity: as far as the correlation reaches, to both sides; a multiple of 4.
    """

    def __init__(self, *, max_disparity: int) -> None:
        super().__init__()
        self.features = Features()
        self.correlation = SignedCorrelation(radius=max_disparity // CORRELATED)
        self.encoder = Encoder(self.correlation.out_channels)
        self.predict = nn.Conv2d(BOTTOM, 1, 3, padding=1)
        given = (BOTTOM, 512, 256, 128, 64, 32)
        skips = (*reversed(SKIPS), 3)
        widths = (512, 256, 128, 64, 32, 16)
        merged = (512, 256, 128, 64, 32, 32)
        self.levels = nn.ModuleList(
            UpLevel(channels, skip, width, merged=out, bias=True)
            for channels, skip, width, out in zip(given, skips, widths, merged, strict=True)
        )

    def forward(self, left: Tensor, right: Tensor) -> Estimates:
        """Images (B, 3, H, W) to disparities of strides 64 to 1."""
        (half, _), (quarter, of_right) = (maps.chunk(2) for maps in self.features(torch.cat((left, right))))
        *coarse, x = self.encoder(self.correlation(quarter, of_right), quarter)
        raw = [self.predict(x)]
        for level, skip in zip(self.levels, (*reversed(coarse), quarter, half, left), strict=True):
            x, disparity = level(x, raw[-1], skip)
            raw.append(disparity)
        return Estimates([at_least_float32(disparity) for disparity in raw])


class ResidualLevel(nn.Module):
    """Doubles the map and the disparity, merges the skip, and predicts what the first stage lacks.

    Args:
        in_channels: of the map.
        width: channels of the skip, and of the map once it is doubled.
        merges: whether a convolution merges the skip, or the prediction is made of both as they are.
    """

    def __init__(self, in_channels: int, width: int, *, merges: bool = True) -> None:
        super().__init__()
        self.up = conv(in_channels, width, 4, stride=2, transposed=True)
        self.up_disparity = nn.ConvTranspose2d(1, 1, 4, stride=2, padding=1)
        self.merge = conv(2 * width + 1, width, activation=None) if merges else nn.Identity()
        self.predict = nn.Conv2d(width, 1, 3, padding=1) if merges else nn.Conv2d(2 * width + 1, 1, 5, padding=2)

    def forward(self, x: Tensor, disparity: Tensor, skip: Tensor) -> tuple[Tensor, Tensor]:
        """Map (B, C, h, w) and disparity (B, 1, h, w) to a map and a residual of twice the size."""
        merged = self.merge(torch.cat((skip, self.up(x), self.up_disparity(disparity)), dim=1))
        return merged, self.predict(merged)


class DispResNet(nn.Module):
    """The second stage: residuals at strides 16 to 1, each added to the first stage's disparity at that stride."""

    def __init__(self) -> None:
        super().__init__()
        widths = (64, 128, 256, 512, 1024)
        self.first = conv(1 + 4 * 3, widths[0], 5)
        self.down = nn.ModuleList(
            nn.Sequential(conv(given, width, 5 if i == 0 else 3, stride=2), conv(width, width))
            for i, (given, width) in enumerate(pairwise(widths))
        )
        self.predict = nn.Conv2d(widths[-1], 1, 3, padding=1)
        self.levels = nn.ModuleList(
            ResidualLevel(given, width, merges=width != widths[0]) for given, width in pairwise(reversed(widths))
        )

    def forward(self, left: Tensor, right: Tensor, disparity: Tensor) -> Estimates:
        """Images (B, 3, H, W) and a disparity (B, 1, H, W) to disparities of strides 16 to 1."""
        # the right view, seen from where the left one is if the disparity is right
        synthetic = warp(right, disparity).squeeze(2)
        maps = [self.first(torch.cat((disparity.to(left.dtype), left, right, synthetic, left - synthetic), dim=1))]
        for level in self.down:
            maps.append(level(maps[-1]))
        *skips, x = maps
        raw = [self._added(self.predict(x), disparity)]
        for level, skip in zip(self.levels, reversed(skips), strict=True):
            x, residual = level(x, F.relu(raw[-1]).to(x.dtype), skip)
            raw.append(self._added(residual, disparity))
        return Estimates(raw)

    @staticmethod
    def _added(residual: Tensor, disparity: Tensor) -> Tensor:
        height, width = residual.shape[-2:]
        at_its_size = disparity if width == disparity.shape[-1] else tent_means(disparity, height, width)
        return at_least_float32(residual) + at_its_size


@MODELS.register("crl")
class CRL(StereoNetwork):
    """Cascade residual learning: DispFulNet finds a disparity, DispResNet mends it.

    The second stage sees both images, the first one's disparity, the right image warped by it, and the difference of
    that from the left one. Nothing flows back from it to the first stage, as in the published network, whose first
    stage was trained before. All predictions are in px of the full-size image; they are set to 0 where they are below,
    but for the loss, for which such a pixel would have no gradient.

    There is no distribution over disparities, and so no confidence.

    Args:
        max_disparity: as far as the correlation reaches, to both sides; a multiple of 4. Estimates may lie beyond.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: a reach that is no multiple of 4, or another preprocessing.

    Source: Pang et al., "Cascade residual learning", ICCV workshops 2017. The weights of its losses were not
    published: 1 for the finest prediction of each stage, and DispNet's 0.2 for the others.

    >>> model = CRL(max_disparity=32).eval()
    >>> output = model(*torch.rand(2, 1, 3, 50, 70))
    >>> output.disparity.shape, output.confidence
    (torch.Size([1, 50, 70]), None)
    """

    def __init__(
        self,
        *,
        max_disparity: int = 160,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        statistics: Statistics = "fixed",
        padding: Padding = "replicate",
        corner: Corner = "bottom_right",
    ) -> None:
        check_max_disparity(max_disparity, CORRELATED, f"maps of stride {CORRELATED}")
        super().__init__(
            max_disparity=max_disparity,
            multiple=64,
            loss_weights=(*(0.2,) * 6, 1.0, *(0.2,) * 4, 1.0),
            preprocessing=Preprocessing(mean=mean, std=std, statistics=statistics, padding=padding, corner=corner),
        )
        self.first = DispFulNet(max_disparity=max_disparity)
        self.second = DispResNet()

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Images, normalised and padded, to the output."""
        first = self.first(left, right)
        second = self.second(left, right, first.disparity.detach())
        predictions = [
            Prediction(raw.squeeze(1), left.shape[-1] // raw.shape[-1])
            for raw in ([*first.raw, *second.raw] if self.training else second.raw[-1:])
        ]
        return StereoOutput(second.disparity.squeeze(1), tuple(predictions))
