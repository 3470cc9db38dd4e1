"""HD3 for stereo: a distribution over what is left of the disparity, at six scales from coarse to fine.

Yin et al., "Hierarchical discrete distribution decomposition for match density estimation", CVPR 2019. It has no
slots: each scale looks around the disparity of the one before.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.aggregation.dilated_context import dilated_layers
from stereokit.backbones.deep_aggregation import DeepAggregation
from stereokit.config import IMAGENET_MEAN, IMAGENET_STD, Corner, Padding, Statistics
from stereokit.contracts import Distribution, Prediction, StereoOutput
from stereokit.costs.warped_correlation import WarpedCorrelation
from stereokit.layers import at_least_float32, bilinear_upsample
from stereokit.network import Preprocessing, StereoNetwork
from stereokit.registry import MODELS
from stereokit.regression.most_probable_pair import MostProbablePair
from stereokit.weights.key_map import publish

__all__ = ["HD3S", "HD3SC"]

STRIDES = (64, 32, 16, 8, 4, 2)

RADIUS = 4
"""How far each scale looks around what the one before says, to both sides, in its pixels."""

SHIFTS = 2 * RADIUS + 1

WIDTH = 128
"""Channels of the decoders."""


def _norm_act_conv(in_channels: int, out_channels: int, kernel_size: int, *, bias: bool = False) -> list[nn.Module]:
    conv = nn.Conv2d(in_channels, out_channels, kernel_size, padding=kernel_size // 2, bias=bias)
    return [nn.BatchNorm2d(in_channels), nn.ReLU(inplace=True), conv]


class Decoder(nn.Module):
    """Two residual blocks whose norms come first, and a root that merges the outputs of both.

    Args:
        in_channels: of the input.
    """

    def __init__(self, in_channels: int) -> None:
        super().__init__()
        first = nn.Conv2d(in_channels, WIDTH, 3, padding=1, bias=False)
        self.block1 = nn.Sequential(first, *_norm_act_conv(WIDTH, WIDTH, 3))
        self.skip = nn.Conv2d(in_channels, WIDTH, 1, bias=False)
        self.block2 = nn.Sequential(*_norm_act_conv(WIDTH, WIDTH, 3), *_norm_act_conv(WIDTH, WIDTH, 3))
        self.root = nn.Sequential(*_norm_act_conv(2 * WIDTH, WIDTH, 1))

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, h, w) to (B, 128, h, w)."""
        x1 = self.block1(x) + self.skip(x)
        x2 = self.block2(x1) + x1
        merged: Tensor = self.root(torch.cat((x1, x2), dim=1))
        return merged


class Density(NamedTuple):
    """What is said at one scale."""

    logits: Tensor
    """(B, 9, h, w), of the candidates."""
    candidates: Tensor
    """(B, 9, h, w), in pixels of the maps: what the scale before says, and up to 4 to both sides of it."""
    disparity: Tensor
    """(B, h, w), likewise; never negative."""
    confidence: Tensor
    """(B, h, w): the mass behind it."""
    map: Tensor | None
    """(B, 9, 2h, 2w), for the next scale; None at the last one."""


class Level(nn.Module):
    """One scale: correlation around the disparity of the scale before, decoder, density and its best estimate.

    Args:
        channels: of the features.
        first: there is no scale before.
        last: there is none behind.
        context: a context module in place of the decoder.
    """

    def __init__(self, channels: int, *, first: bool, last: bool, context: bool) -> None:
        super().__init__()
        given = SHIFTS if first else SHIFTS + channels + SHIFTS + 1
        self.correlation = WarpedCorrelation(radius=RADIUS)
        self.norm = nn.BatchNorm2d(SHIFTS)
        self.decoder = dilated_layers(given, WIDTH) if context else Decoder(given)
        self.head = (
            nn.Conv2d(WIDTH, SHIFTS, 1) if context else nn.Sequential(*_norm_act_conv(WIDTH, SHIFTS, 1, bias=True))
        )
        self.regression = MostProbablePair()
        self.up = (
            None
            if last
            else nn.Sequential(
                nn.BatchNorm2d(WIDTH),
                nn.ReLU(inplace=True),
                nn.ConvTranspose2d(WIDTH, SHIFTS, 4, stride=2, padding=1, bias=False),
                nn.BatchNorm2d(SHIFTS),
                nn.ReLU(inplace=True),
            )
        )

    def forward(self, left: Tensor, right: Tensor, before: Density | None) -> Density:
        """Features (B, channels, h, w) and what the scale before says to what this one does."""
        disparity = None
        if before is not None:
            disparity = 2 * bilinear_upsample(before.disparity, 2, align_corners=True)
        x = self.norm(self.correlation(left, right, disparity))
        if before is not None and before.map is not None and disparity is not None:
            x = torch.cat((x, left, before.map, disparity.unsqueeze(1).to(left.dtype)), dim=1)
        x = self.decoder(x)
        # as in the correlation, the first class is the one furthest to the right in the right view
        logits = self.head(x).flip(1)
        around = torch.arange(-RADIUS, RADIUS + 1, device=x.device, dtype=at_least_float32(x).dtype).reshape(-1, 1, 1)
        candidates = (around if disparity is None else disparity.unsqueeze(1) + around).expand_as(logits)
        estimate, confidence = self.regression.with_confidence(logits, candidates)
        return Density(logits, candidates, F.relu(estimate), confidence, None if self.up is None else self.up(x))


class _HD3(StereoNetwork):
    """What both networks share."""

    def __init__(
        self, *, max_disparity: int, pretrained_backbone: bool, context: bool, preprocessing: Preprocessing
    ) -> None:
        super().__init__(
            max_disparity=max_disparity,
            multiple=STRIDES[0],
            loss_weights=(1.0,) * len(STRIDES),
            preprocessing=preprocessing,
        )
        self.backbone = DeepAggregation(pretrained=pretrained_backbone)
        channels = self.backbone.info.matching_channels
        first, last = STRIDES[0], STRIDES[-1]
        self.levels = nn.ModuleList(
            Level(channels[stride], first=stride == first, last=stride == last, context=context and stride == last)
            for stride in STRIDES
        )
        # as it was published; DLA-34 itself begins as it does elsewhere
        for layer in (*self.levels.modules(), *self.backbone.aggregations.modules()):
            if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.normal_(layer.weight, std=0.02)
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Images, normalised and padded, to the output."""
        features = self.backbone(torch.cat((left, right))).matching
        densities: list[Density] = []
        for stride, level in zip(STRIDES, self.levels, strict=True):
            of_left, of_right = features[stride].chunk(2)
            densities.append(level(of_left, of_right, densities[-1] if densities else None))
        predictions = [
            Prediction(
                stride * density.disparity,
                stride,
                Distribution(density.logits, stride, float(stride), values=stride * density.candidates),
            )
            for stride, density in zip(STRIDES, densities, strict=True)
        ]
        finest = predictions[-1]
        return StereoOutput(
            bilinear_upsample(finest.disparity, finest.stride, align_corners=True),
            tuple(predictions if self.training else predictions[-1:]),
            bilinear_upsample(densities[-1].confidence, finest.stride),
        )


@MODELS.register("hd3s")
class HD3S(_HD3):
    """Six scales of DLA-34, each with a distribution over the nine residuals next to the estimate of the one before.

    All are trained, with equal weights; the gradient of each flows into the ones before. The finest is of stride 2, and
    enlarged bilinearly. The confidence is the probability of the two levels that the estimate lies between.

    The scales reach 504 px together, whatever `max_disparity`: it is what tiles and errors reckon with.

    Args:
        max_disparity: in px, see above.
        pretrained_backbone: load timm's weights for DLA-34.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: another preprocessing.

    Source: Yin et al., "Hierarchical discrete distribution decomposition for match density estimation", CVPR 2019.

    >>> output = HD3S().eval()(*torch.rand(2, 1, 3, 50, 70))
    >>> output.disparity.shape, output.confidence.shape
    (torch.Size([1, 50, 70]), torch.Size([1, 50, 70]))
    """

    context = False

    def __init__(
        self,
        *,
        max_disparity: int = 192,
        pretrained_backbone: bool = False,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        statistics: Statistics = "fixed",
        padding: Padding = "replicate",
        corner: Corner = "bottom_right",
    ) -> None:
        super().__init__(
            max_disparity=max_disparity,
            pretrained_backbone=pretrained_backbone,
            context=self.context,
            preprocessing=Preprocessing(mean=mean, std=std, statistics=statistics, padding=padding, corner=corner),
        )


@MODELS.register("hd3sc")
class HD3SC(HD3S):
    """`HD3S` with a context module, convolutions of growing dilation, at its finest scale.

    Args:
        max_disparity: in px, see `HD3S`.
        pretrained_backbone: load timm's weights for DLA-34.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: another preprocessing.

    Source: Yin et al., CVPR 2019, section 4.

    >>> HD3SC().eval()(*torch.rand(2, 1, 3, 50, 70)).disparity.shape
    torch.Size([1, 50, 70])
    """

    context = True


BACKBONE = [
    ("base.base_layer.", "stem.0."),
    ("base.level0.", "stem.1."),
    ("base.level{n}.", "levels.{n-1}."),
    ("dla_up.ida_{i}.proj_{n}.", "aggregations.{i}.project.{n-1}."),
    ("dla_up.ida_{i}.up_{n}.", "aggregations.{i}.up.{n-1}."),
    ("dla_up.ida_{i}.node_{n}.", "aggregations.{i}.merge.{n-1}."),
]


def _positive(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The published network reads flow along x, which is negative disparity: the weights that read it change sign."""
    for number in range(1, len(STRIDES)):
        decoder = f"levels.{number}.decoder."
        for name in ("block1.0.weight", "skip.weight", "0.0.weight"):
            if (weight := state.get(decoder + name)) is not None:
                state[decoder + name] = torch.cat((weight[:, :-1], -weight[:, -1:]), dim=1)
    return state


AUTHORS: dict[str, Any] = {
    "source": "the authors' checkpoints",
    "licence": "BSD-3",
    # outer projections of trees of depth 2
    "unused": ("encoder.base.level3.project.", "encoder.base.level4.project."),
    "convert": _positive,
}

KEYS = (
    *((f"encoder.{theirs}", f"backbone.{ours}") for theirs, ours in BACKBONE),
    ("cost_bn_{i}.", "levels.{i}.norm."),
    ("Decoder_{i}.mapping.block1.conv1.", "levels.{i}.decoder.block1.0."),
    ("Decoder_{i}.mapping.block1.bn2.", "levels.{i}.decoder.block1.1."),
    ("Decoder_{i}.mapping.block1.conv2.", "levels.{i}.decoder.block1.3."),
    ("Decoder_{i}.mapping.block1.shortcut.0.", "levels.{i}.decoder.skip."),
    ("Decoder_{i}.mapping.block2.bn1.", "levels.{i}.decoder.block2.0."),
    ("Decoder_{i}.mapping.block2.conv1.", "levels.{i}.decoder.block2.2."),
    ("Decoder_{i}.mapping.block2.bn2.", "levels.{i}.decoder.block2.3."),
    ("Decoder_{i}.mapping.block2.conv2.", "levels.{i}.decoder.block2.5."),
    ("Decoder_{i}.mapping.root.", "levels.{i}.decoder.root."),
    ("Decoder_{i}.up.", "levels.{i}.up."),
)

publish("hd3s", keys=[*KEYS, ("Decoder_{i}.cls.", "levels.{i}.head.")], **AUTHORS)
publish(
    "hd3sc",
    keys=[
        *KEYS,
        ("Decoder_5.dc_conv_{n}.", "levels.5.decoder.{n}."),
        ("Decoder_5.cls.", "levels.5.head."),
        ("Decoder_{i}.cls.", "levels.{i}.head."),
    ],
    **AUTHORS,
)
