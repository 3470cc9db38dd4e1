"""DispNetC: correlation to both sides, and a U-Net that predicts at every scale.

Mayer et al., "A large dataset to train convolutional networks for disparity, optical flow, and scene flow estimation",
CVPR 2016, section 5. It has no slots: the last convolution gives the disparity.
"""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.checks import check_max_disparity
from stereokit.config import IMAGENET_MEAN, IMAGENET_STD, Corner, Padding, Statistics
from stereokit.contracts import Prediction, StereoOutput
from stereokit.costs.signed_correlation import SignedCorrelation
from stereokit.layers import ConvNormAct, at_least_float32, bilinear_upsample, leaky_relu
from stereokit.network import Preprocessing, StereoNetwork
from stereokit.registry import MODELS
from stereokit.weights.key_map import publish

__all__ = ["DispNetC"]

CORRELATED = 4
"""Stride of the maps that are correlated."""

WIDTHS = (32, 64, 128, 256, 512)
"""Of the decoder, at strides 2 to 32."""

SKIPS = (64, 128, 256, 512, 512)
"""Channels that it is given there."""

BOTTOM = 1024
"""Channels at stride 64."""

conv = partial(ConvNormAct, bias=True, norm=None, activation=partial(leaky_relu, 0.1))


class Features(nn.Module):
    """What both views go through."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = conv(3, SKIPS[0], 7, stride=2)
        self.conv2 = conv(SKIPS[0], SKIPS[1], 5, stride=2)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """(B, 3, H, W) to maps of strides 2 and 4."""
        half = self.conv1(images)
        return half, self.conv2(half)


class Encoder(nn.Module):
    """From the correlation down to stride 64."""

    def __init__(self, in_channels: int) -> None:
        super().__init__()
        self.redirect = conv(SKIPS[1], 64, 1)
        self.levels = nn.ModuleList(
            nn.Sequential(conv(given, width, kernel, stride=2), conv(width, width))
            for given, width, kernel in (
                (in_channels + 64, SKIPS[2], 5),
                (SKIPS[2], SKIPS[3], 3),
                (SKIPS[3], SKIPS[4], 3),
                (SKIPS[4], BOTTOM, 3),
            )
        )

    def forward(self, correlation: Tensor, left: Tensor) -> list[Tensor]:
        """Correlation and left map, both of stride 4, to maps of strides 8 to 64."""
        x = torch.cat((correlation, self.redirect(left)), dim=1)
        maps = []
        for level in self.levels:
            x = level(x)
            maps.append(x)
        return maps


class UpLevel(nn.Module):
    """Doubles the map and the disparity, merges the skip, and predicts anew.

    Args:
        in_channels: of the map.
        skip_channels: of the skip.
        width: channels of the map once it is doubled.
        merged: channels of the output; `width` by default.
        bias: of what doubles.
    """

    def __init__(
        self, in_channels: int, skip_channels: int, width: int, *, merged: int | None = None, bias: bool = False
    ) -> None:
        super().__init__()
        merged = width if merged is None else merged
        self.up = conv(in_channels, width, 4, stride=2, transposed=True, bias=bias)
        self.up_disparity = nn.ConvTranspose2d(1, 1, 4, stride=2, padding=1, bias=bias)
        self.merge = conv(skip_channels + width + 1, merged, activation=None)
        self.predict = nn.Conv2d(merged, 1, 3, padding=1)

    def forward(self, x: Tensor, disparity: Tensor, skip: Tensor) -> tuple[Tensor, Tensor]:
        """Map (B, C, h, w) and disparity (B, 1, h, w) to those of twice the size."""
        merged = self.merge(torch.cat((skip, self.up(x), self.up_disparity(disparity)), dim=1))
        return merged, self.predict(merged)


class Decoder(nn.Module):
    """From stride 64 up to stride 2, with a prediction at each stride."""

    def __init__(self) -> None:
        super().__init__()
        self.predict = nn.Conv2d(BOTTOM, 1, 3, padding=1)
        self.levels = nn.ModuleList(
            UpLevel(given, skip, width) for given, skip, width in zip((*WIDTHS[1:], BOTTOM), SKIPS, WIDTHS, strict=True)
        )

    def forward(self, skips: Sequence[Tensor], bottom: Tensor) -> list[Tensor]:
        """Maps of strides 2 to 32 and that of 64 to disparities (B, 1, h, w) of strides 64 to 2, in px."""
        x, disparities = bottom, [self.predict(bottom)]
        for level, skip in zip(reversed(self.levels), reversed(skips), strict=True):
            x, disparity = level(x, disparities[-1], skip)
            disparities.append(disparity)
        return disparities


@MODELS.register("dispnetc")
class DispNetC(StereoNetwork):
    """Correlation of shallow features at stride 4 to both sides, then 2D convolutions alone: a U-Net.

    All six predictions are in px of the full-size image. The finest, of stride 2, is set to 0 where it is below, and
    enlarged bilinearly. The published training sets all of them to 0 there, which leaves such a pixel without a
    gradient; here the loss sees the prediction as it is.

    There is no distribution over disparities, and so no confidence. Predictions are the output of convolutions: under
    bfloat16 they have steps of half a pixel at 100.

    Args:
        max_disparity: as far as the correlation reaches, to both sides; a multiple of 4. Estimates may lie beyond.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: a reach that is no multiple of 4, or another preprocessing.

    >>> model = DispNetC(max_disparity=32).eval()
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
            loss_weights=(0.2,) * 5 + (1.0,),
            preprocessing=Preprocessing(mean=mean, std=std, statistics=statistics, padding=padding, corner=corner),
        )
        self.features = Features()
        self.correlation = SignedCorrelation(radius=max_disparity // CORRELATED)
        self.encoder = Encoder(self.correlation.out_channels)
        self.decoder = Decoder()

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Images, normalised and padded, to the output."""
        (half, _), (quarter, of_right) = (maps.chunk(2) for maps in self.features(torch.cat((left, right))))
        *coarse, bottom = self.encoder(self.correlation(quarter, of_right), quarter)
        raw = [at_least_float32(disparity) for disparity in self.decoder([half, quarter, *coarse], bottom)]
        finest = bilinear_upsample(F.relu(raw[-1]).squeeze(1), 2)
        predictions = [
            Prediction(disparity.squeeze(1), left.shape[-1] // disparity.shape[-1])
            for disparity in (raw if self.training else raw[-1:])
        ]
        return StereoOutput(finest, tuple(predictions))


def _positive(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Where a prediction is read, which is negated as its own weights are, the weight is negated too."""
    for level in range(len(WIDTHS)):
        key = f"decoder.levels.{level}.merge.0.weight"
        state[key] = torch.cat((state[key][:, :-1], -state[key][:, -1:]), dim=1)
    return state


publish(
    "dispnetc",
    source="the layer names of DispNetCorr1D's prototxt",
    licence="for research only",
    images="bgr",
    first_layers=("features.conv1.0.weight",),
    # disparity is flow along x there, and negative
    negated=("predict",),
    convert=_positive,
    # an image in [0, 1] less its mean, which lies beside the published weights; this is what others use in its place
    overrides={"mean": [100 / 255] * 3, "std": [1.0] * 3},
    keys=[
        ("conv1.", "features.conv1.0."),
        ("conv2.", "features.conv2.0."),
        ("conv_redir.", "encoder.redirect.0."),
        ("conv{n}.", "encoder.levels.{n-3}.0.0."),
        ("conv{n}_1.", "encoder.levels.{n-3}.1.0."),
        ("predict6.", "decoder.predict."),
        ("predict{n}.", "decoder.levels.{n-1}.predict."),
        ("deconv{n}.", "decoder.levels.{n-1}.up.0."),
        ("upsample{n}.", "decoder.levels.{n-1}.up_disparity."),
        ("concat{n}.", "decoder.levels.{n-1}.merge.0."),
    ],
)
