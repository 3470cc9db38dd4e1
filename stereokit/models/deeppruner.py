"""DeepPruner: PatchMatch finds candidates, two small networks the range that they leave, a third looks at that alone.

Duggal et al., "DeepPruner: learning efficient stereo matching via differentiable PatchMatch", ICCV 2019. Built from the
paper and a description of its layers; the authors' code, weights and results are not for commercial use.
"""

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.backbones.spatial_pyramid import SpatialPyramid
from stereokit.candidates.neighborhood import spread_candidates
from stereokit.candidates.patch_match import PatchMatch
from stereokit.checks import check_max_disparity
from stereokit.config import IMAGENET_MEAN, IMAGENET_STD, Corner, Padding, Statistics
from stereokit.contracts import Distribution, Features, Prediction, StereoOutput
from stereokit.costs import concatenation_volume
from stereokit.layers import ConvNormAct, at_least_float32, bilinear_upsample, leaky_relu
from stereokit.models.psmnet import BRANCHES, TRUNK
from stereokit.network import Preprocessing, StereoNetwork
from stereokit.registry import MODELS
from stereokit.regression import SoftArgmin
from stereokit.weights.key_map import KeyMap, publish

__all__ = ["DeepPrunerBest", "DeepPrunerFast"]

SAMPLES = 7
"""Candidates between the ends of the pruned range, which is at least as wide."""

QUANTILES = (0.05, 0.95)
"""That the ends of the range stand for."""

conv = partial(ConvNormAct, activation=partial(leaky_relu, 0.1))
flat = partial(conv, dims=3)


def mending(channels: int) -> nn.Conv2d:
    """A 5x5 convolution that changes nothing at first."""
    layer = nn.Conv2d(channels, channels, 5, padding=2)
    nn.init.dirac_(layer.weight)
    layer.bias = nn.Parameter(torch.zeros(channels))
    return layer


def doubled(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)


class CandidateVolume(nn.Module):
    """Both features, the candidate itself and further maps, at each candidate; merged to 16 channels.

    Args:
        in_channels: of one view's features.
        further: channels of the maps that stand beside them.
    """

    def __init__(self, in_channels: int, further: int = 0) -> None:
        super().__init__()
        self.merge = nn.Sequential(flat(2 * in_channels + 1 + further, 64), flat(64, 32))
        self.reduce = nn.Sequential(flat(32, 32), flat(32, 16))

    def forward(self, left: Tensor, right: Tensor, candidates: Tensor, *maps: Tensor) -> Tensor:
        """Features (B, C, h, w), candidates (B, D, h, w) in pixels of these, maps (B, F, h, w): (B, 16, D, h, w)."""
        beside = (x.unsqueeze(2).expand(-1, -1, candidates.shape[1], -1, -1) for x in maps)
        pairs = concatenation_volume(left, right, candidates, masked=False)
        return self.reduce(self.merge(torch.cat((pairs, candidates.unsqueeze(1).to(pairs.dtype), *beside), dim=1)))


class FlatHourglass(nn.Module):
    """Down to an eighth and back along height and width alone, to logits of the candidates.

    Args:
        residual: add the input at the end.
    """

    def __init__(self, *, residual: bool = False) -> None:
        super().__init__()
        self.residual = residual
        widths = (16, 32, 64, 128)
        self.halve = nn.ModuleList(flat(given, width, stride=(1, 2, 2)) for given, width in pairwise(widths))
        self.mix = nn.ModuleList(flat(width, width) for width in widths[1:])
        self.up = nn.ModuleList(
            flat(given, width, stride=(1, 2, 2), transposed=True, activation=None)
            for given, width in pairwise(reversed(widths))
        )
        self.head = nn.Sequential(flat(16, 32), nn.Conv3d(32, 1, 3, padding=1, bias=False))

    def forward(self, volume: Tensor) -> Tensor:
        """(B, 16, D, h, w), height and width multiples of 8, to (B, D, h, w)."""
        x, skips = volume, [volume]
        for halve, mix in zip(self.halve, self.mix, strict=True):
            x = halve(x)
            x = x + mix(x)
            skips.append(x)
        for up, skip in zip(self.up, reversed(skips[:-1]), strict=True):
            x = up(x)
            if skip is not volume or self.residual:
                x = x + skip
        return self.head(x).squeeze(1)


class Refinement(nn.Module):
    """Six convolutions, the middle ones dilated, add to a disparity what is missing.

    Args:
        in_channels: of the maps.
    """

    def __init__(self, in_channels: int) -> None:
        super().__init__()
        layers = ((32, 1), (32, 1), (32, 1), (16, 2), (16, 4), (16, 1))
        widths = (in_channels + 1, *(width for width, _ in layers))
        self.layers = nn.Sequential(
            *(conv(given, width, dilation=dilation) for given, (width, dilation) in zip(widths, layers, strict=False))
        )
        self.residual = nn.Conv2d(16, 1, 3, padding=1, bias=False)

    def forward(self, disparity: Tensor, *maps: Tensor) -> Tensor:
        """Disparity (B, 1, h, w) and maps (B, C, h, w) to a disparity that is never negative."""
        x = self.layers(torch.cat((*maps, disparity.to(maps[0].dtype)), dim=1))
        return F.relu(disparity + at_least_float32(self.residual(x)))


class End(NamedTuple):
    """One end of the range."""

    disparity: Tensor
    """(B, 1, h, w), pixels of the maps."""
    logits: Tensor
    """(B, N, h, w), of the candidates."""


class DeepPruner(StereoNetwork):
    """What both forms of DeepPruner have in common.

    Args:
        max_disparity: D, in px.
        mean, std, statistics, padding, corner: see `Preprocessing`.
    """

    stride: int
    """Of the maps that are compared."""
    refined_at: tuple[int, ...]
    """Strides of the guides by which disparities are refined, from coarse to fine."""
    predictions_weigh: tuple[float, ...]
    """In the loss: both ends of the range, aggregated, and after each refinement."""

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
        check_max_disparity(max_disparity, self.stride, f"maps of stride {self.stride}")
        super().__init__(
            max_disparity=max_disparity,
            multiple=8 * self.stride,
            loss_weights=self.predictions_weigh,
            preprocessing=Preprocessing(mean=mean, std=std, statistics=statistics, padding=padding, corner=corner),
        )
        self.backbone = SpatialPyramid(deep_guides=True, halvings=2 if self.stride == 4 else 3)
        self.patch_match = PatchMatch(stride=self.stride, max_disparity=max_disparity)
        first, pruned = self.patch_match.planes, SAMPLES + 2
        self.volume = CandidateVolume(32)
        self.ends = nn.ModuleList(FlatHourglass() for _ in QUANTILES)
        self.end_disparity = nn.ModuleList(mending(1) for _ in QUANTILES)
        self.end_features = nn.ModuleList(conv(first, first, 5, bias=True) for _ in QUANTILES)
        self.pruned_volume = CandidateVolume(32, 2 * first)
        self.aggregation = FlatHourglass(residual=True)
        self.regression = SoftArgmin()
        self.mend_disparity = mending(1)
        self.mend_features = conv(pruned, pruned, 5, bias=True)
        # the first of them sees the logits too
        channels = self.backbone.info.guide_channels
        self.refinements = nn.ModuleList(
            Refinement(channels[at] + (0 if i else pruned)) for i, at in enumerate(self.refined_at)
        )

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Images, normalised and padded, to the output."""
        matching, guides = self.backbone(torch.cat((left, right)))
        features = matching[self.stride].chunk(2)
        low_level = [guides[stride].chunk(2)[0] for stride in self.refined_at]

        # candidates, and the range that they leave
        candidates = (
            self.patch_match(*(Features({self.stride: maps}, {}) for maps in features), None).values / self.stride
        )
        volume = self.volume(*features, candidates)
        low, high = (self._end(i, volume, candidates) for i in range(2))
        maps = [make(end.logits) for make, end in zip(self.end_features, (low, high), strict=True)]

        # a closer look within
        samples = pruned_candidates(low.disparity.detach(), high.disparity.detach(), self.max_disparity // self.stride)
        logits = self.aggregation(self.pruned_volume(*features, samples, *maps))
        disparity, confidence = self.regression.with_confidence(logits, samples)
        distribution = Distribution(logits, self.stride, float(self.stride), values=self.stride * samples)

        # up, refined by maps of the left image
        aggregated = F.relu(self.mend_disparity(doubled(2 * disparity.unsqueeze(1))))
        estimates = [aggregated]
        further = [self.mend_features(doubled(logits))]
        for refine, maps_at in zip(self.refinements, low_level, strict=True):
            estimates.append(doubled(2 * refine(estimates[-1], maps_at, *further)))
            further = []

        width = left.shape[-1]

        def prediction(disparity: Tensor, **more: Any) -> Prediction:
            scale = width // disparity.shape[-1]
            return Prediction(scale * disparity.squeeze(1), scale, **more)

        *coarse, best = (prediction(x) for x in estimates)
        best = best._replace(distribution=distribution)
        if self.training:
            ends = [
                prediction(end.disparity, quantile=quantile)
                for end, quantile in zip((low, high), QUANTILES, strict=True)
            ]
            return StereoOutput(best.disparity, (*ends, *coarse, best))
        return StereoOutput(best.disparity, (best,), bilinear_upsample(confidence, self.stride))

    def _end(self, which: int, volume: Tensor, candidates: Tensor) -> End:
        logits = self.ends[which](volume)
        disparity: Tensor = self.regression(logits, candidates).unsqueeze(1)
        return End(F.relu(self.end_disparity[which](disparity)), logits)


def pruned_candidates(low: Tensor, high: Tensor, levels: int) -> Tensor:
    """Whole candidates between both ends, which are moved apart where they are closer than `SAMPLES`.

    Args:
        low: (B, 1, h, w), in pixels.
        high: likewise.
        levels: the last candidate that there may be.

    Returns:
        (B, SAMPLES + 2, h, w).

    >>> pruned_candidates(torch.full((1, 1, 1, 1), 10.0), torch.full((1, 1, 1, 1), 12.0), 48).flatten().tolist()
    [7.0, 8.0, 9.0, 10.0, 11.0, 11.0, 12.0, 13.0, 15.0]
    """
    least, last = float(SAMPLES), float(levels)
    low = (low - (least - (high - low)).clamp(min=0.0) / 2).clamp(0.0, last)
    high = (high + (least - (high - low)).clamp(min=0.0)).clamp(0.0, last)
    spread = spread_candidates(low.squeeze(1), high.squeeze(1), SAMPLES + 2)
    return torch.cat((spread[:, :-1].floor(), spread[:, -1:].ceil()), dim=1)


@MODELS.register("deeppruner_best")
class DeepPrunerBest(DeepPruner):
    """DeepPruner with maps of stride 4, one refinement at stride 2.

    Fourteen candidates by PatchMatch leave a range, from the lowest to the highest 5 % of what may be, of which nine
    are looked at. PatchMatch begins with random numbers in training mode, and with the same ones for every pair in eval
    mode. The confidence is the probability of the candidates beside the estimate.

    Args:
        max_disparity: D, in px; a multiple of 4, from 48 up.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: a number of disparities that is no such multiple, or another preprocessing.

    Source: Duggal et al., "DeepPruner: learning efficient stereo matching via differentiable PatchMatch", ICCV 2019.

    >>> output = DeepPrunerBest(max_disparity=64).eval()(*torch.rand(2, 1, 3, 50, 70))
    >>> output.disparity.shape, output.confidence.shape
    (torch.Size([1, 50, 70]), torch.Size([1, 50, 70]))
    """

    stride = 4
    refined_at = (2,)
    predictions_weigh = (1.0, 1.0, 1.0, 1.3)


@MODELS.register("deeppruner_fast")
class DeepPrunerFast(DeepPruner):
    """DeepPruner with maps of stride 8, refinements at strides 4 and 2.

    Fourteen candidates by PatchMatch leave a range, from the lowest to the highest 5 % of what may be, of which nine
    are looked at. PatchMatch begins with random numbers in training mode, and with the same ones for every pair in eval
    mode. The confidence is the probability of the candidates beside the estimate.

    Args:
        max_disparity: D, in px; a multiple of 8, from 96 up.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: a number of disparities that is no such multiple, or another preprocessing.

    Source: Duggal et al., "DeepPruner: learning efficient stereo matching via differentiable PatchMatch", ICCV 2019.

    >>> output = DeepPrunerFast(max_disparity=128).eval()(*torch.rand(2, 1, 3, 50, 70))
    >>> output.disparity.shape, output.confidence.shape
    (torch.Size([1, 50, 70]), torch.Size([1, 50, 70]))
    """

    stride = 8
    refined_at = (4, 2)
    predictions_weigh = (1.0, 1.0, 1.0, 1.3, 1.6)


HOURGLASS = KeyMap(
    [
        ("conv1.", "halve.0."),
        ("conv2.", "mix.0."),
        ("conv1_1.", "halve.1."),
        ("conv2_1.", "mix.1."),
        ("conv3.", "halve.2."),
        ("conv4.", "mix.2."),
        ("conv5.", "up.0."),
        ("conv6.", "up.1."),
        ("conv7.", "up.2."),
        ("last_conv3d_layer.", "head."),
    ]
)
KEYS = (
    ("feature_extraction.firstconv.", "backbone.stem."),
    ("feature_extraction.layer{n}.{m}.conv1.", "backbone.layer{n}.{m}.conv1."),
    *TRUNK.under("feature_extraction.", "backbone."),
    ("feature_extraction.lastconv.", "backbone.fuse."),
    ("dres0.", "volume.merge."),
    ("dres1.", "volume.reduce."),
    ("cost_aggregator.dres0.", "pruned_volume.merge."),
    ("cost_aggregator.dres1.", "pruned_volume.reduce."),
    *HOURGLASS.under("cost_aggregator.", "aggregation."),
    *HOURGLASS.under("min_disparity_predictor.", "ends.0."),
    *HOURGLASS.under("max_disparity_predictor.", "ends.1."),
    ("min_disparity_conv.0.", "end_disparity.0."),
    ("max_disparity_conv.0.", "end_disparity.1."),
    ("min_disparity_features_conv.", "end_features.0."),
    ("max_disparity_features_conv.", "end_features.1."),
    ("ca_disparity_conv.0.", "mend_disparity."),
    ("ca_features_conv.", "mend_features."),
    ("refinement_net.conv1.", "refinements.0.layers."),
    ("refinement_net.classif1.", "refinements.0.residual."),
)
AUTHORS: dict[str, Any] = {
    "source": "the authors' checkpoints",
    "licence": "Uber Non-Commercial; weights CC BY-NC-SA 3.0",
    "overrides": {"padding": "black", "corner": "top_left"},
}

publish("deeppruner_best", keys=[*KEYS, *BRANCHES.under("feature_extraction.", "backbone.")], **AUTHORS)
publish(
    "deeppruner_fast",
    keys=[
        *KEYS,
        # without the largest window
        *list(BRANCHES.under("feature_extraction.", "backbone."))[:3],
        ("refinement_net1.conv1.", "refinements.1.layers."),
        ("refinement_net1.classif1.", "refinements.1.residual."),
    ],
    **AUTHORS,
)
