"""Fast-ACVNet and Fast-ACVNet+: an attention over disparities chooses what a second volume holds.

Xu et al., "Accurate and efficient stereo matching via attention concatenation volume", TPAMI 2023. They have no slots:
the propagation sees both views, and both disparities share one upsampler.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from stereokit.aggregation import AttentionHourglass, AttentionPropagation, Hourglass
from stereokit.backbones import UNet
from stereokit.candidates import most_probable
from stereokit.checks import check_max_disparity
from stereokit.config import IMAGENET_MEAN, IMAGENET_STD, Corner, Padding, Statistics
from stereokit.contracts import Distribution, FeatureInfo, Guides, Prediction, StereoOutput
from stereokit.costs import ConcatenationVolume, CorrelationVolume, GroupwiseCorrelationVolume
from stereokit.errors import ConfigError
from stereokit.guidance import GCE
from stereokit.layers import bilinear_upsample
from stereokit.models.coex import DECODER, EXCITED, MOBILENET, PAIR, STEMS, SUPERPIXELS
from stereokit.network import Preprocessing, StereoNetwork
from stereokit.registry import MODELS
from stereokit.regression import TopKSoftArgmin, soft_argmin
from stereokit.upsampling import SuperpixelUpsampler, superpixel_upsample
from stereokit.upsampling.superpixel import Padding as SuperpixelPadding
from stereokit.weights.key_map import KeyMap, layer, publish

__all__ = ["FastACVNet", "FastACVNetPlus"]

STRIDE = 4
"""Of the maps that the second volume compares."""

STEM_CHANNELS = (32, 48)
"""Of the backbone's stem at strides 2 and 4."""

Maps = Mapping[int, Tensor]


class Attention(nn.Module):
    """Logits over D / 4 levels from a volume of one channel at stride 4, aggregated as in CoEx."""

    def __init__(self, info: FeatureInfo, planes: int) -> None:
        super().__init__()
        self.cost = CorrelationVolume(in_channels=info.matching_channels[STRIDE], planes=planes, projection=(48, 48))
        self.aggregation = Hourglass(in_channels=1, guidance=GCE, guide_channels=info.guide_channels)

    def forward(self, left: Maps, right: Maps, guides: Guides) -> Tensor:
        """Features of both views to (B, D / 4, H / 4, W / 4)."""
        # the mean product of normalised features
        volume = self.cost(left[STRIDE], right[STRIDE]) / self.cost.projection.out_channels
        return self.aggregation(volume, guides)[-1]


class PropagatedAttention(nn.Module):
    """Logits over D / 4 levels from a correlation by groups at stride 8, propagated at stride 4."""

    GROUP_CHANNELS = 8

    def __init__(self, info: FeatureInfo, planes: int) -> None:
        super().__init__()
        self.cost = GroupwiseCorrelationVolume(
            in_channels=info.matching_channels[2 * STRIDE],
            planes=planes // 2,
            group_channels=self.GROUP_CHANNELS,
            normalise=True,
        )
        self.aggregation = AttentionHourglass(
            in_channels=self.cost.out_channels, stride=2 * STRIDE, guidance=GCE, guide_channels=info.guide_channels
        )
        self.propagation = AttentionPropagation()

    def forward(self, left: Maps, right: Maps, guides: Guides) -> Tensor:
        """Features of both views to (B, D / 4, H / 4, W / 4)."""
        volume = self.cost(left[2 * STRIDE], right[2 * STRIDE]) / self.GROUP_CHANNELS
        logits = self.aggregation(volume, guides)[-1]
        # what the stem gives: it stands last
        return self.propagation(logits, *(maps[STRIDE][:, -STEM_CHANNELS[1] :] for maps in (left, right)))


@MODELS.register("fast_acvnet_plus")
class FastACVNetPlus(StereoNetwork):
    """CoEx up to its logits, which are an attention: the most probable levels of each pixel fill a second volume.

    That one concatenates features at these levels alone, weighted by their probability, and goes through a smaller
    hourglass. Both give a disparity in training. The authors train the attention alone for the first half of the
    epochs; here both are trained from the start.

    Args:
        max_disparity: D, in pixels, a multiple of 32.
        candidates: levels of each pixel in the second volume, a multiple of 4; all where there are no more.
        superpixel_padding: see `superpixel_upsample`.
        pretrained_backbone: load timm's weights for the encoder.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: a range or a number of candidates that does not fit, or another preprocessing.

    >>> model = FastACVNetPlus(max_disparity=96).eval()
    >>> model(*torch.rand(2, 1, 3, 50, 70)).disparity.shape
    torch.Size([1, 50, 70])
    """

    stem_channels: tuple[int, ...] = STEM_CHANNELS
    attention_of: type[nn.Module] = Attention

    def __init__(
        self,
        *,
        max_disparity: int = 192,
        candidates: int = 24,
        superpixel_padding: SuperpixelPadding = "replicate",
        pretrained_backbone: bool = False,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
        statistics: Statistics = "fixed",
        padding: Padding = "replicate",
        corner: Corner = "bottom_right",
    ) -> None:
        check_max_disparity(max_disparity, 8 * STRIDE, "the hourglass at stride 4")
        if candidates < 4 or candidates % 4:
            raise ConfigError(f"candidates={candidates!r}: use a multiple of 4, which the hourglass halves twice")
        super().__init__(
            max_disparity=max_disparity,
            multiple=32,
            loss_weights=(0.3, 0.5, 0.3, 1.0),
            preprocessing=Preprocessing(mean=mean, std=std, statistics=statistics, padding=padding, corner=corner),
        )
        planes = max_disparity // STRIDE
        self.candidates = min(candidates, planes)
        self.backbone = UNet(stem_channels=self.stem_channels, pretrained=pretrained_backbone)
        info = self.backbone.info
        self.attention = self.attention_of(info, planes)
        self.cost = ConcatenationVolume(
            in_channels=info.matching_channels[STRIDE],
            planes=self.candidates,
            projection={"widths": [32, 16], "bias": False, "last_kernel": 3},
            masked=False,
        )
        self.aggregation = Hourglass(
            in_channels=self.cost.out_channels,
            channels=(16, 32, 64),
            guidance=GCE,
            guide_channels=info.guide_channels,
        )
        self.regression = TopKSoftArgmin(k=2)
        self.upsampler = SuperpixelUpsampler(
            scale=STRIDE, guide_channels=info.guide_channels, padding=superpixel_padding
        )

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Images, normalised and padded, to the output."""
        features = self.backbone(torch.cat((left, right)))
        of_left, of_right = ({s: x.chunk(2)[i] for s, x in features.matching.items()} for i in (0, 1))
        guides = {s: x.chunk(2)[0] for s, x in features.guides.items()}
        attention = self.attention(of_left, of_right, guides)
        levels, probability = most_probable(attention, self.candidates)
        values = levels.to(probability.dtype)
        volume = self.cost(of_left[STRIDE], of_right[STRIDE], values)
        volume = volume * probability.unsqueeze(1).to(volume.dtype)
        logits = self.aggregation(volume, guides)[-1]
        distribution = Distribution(logits, STRIDE, float(STRIDE), values=STRIDE * values)
        if self.training:
            weights = self.upsampler.weights(guides)
            by_attention = STRIDE * soft_argmin(attention.gather(1, levels), values)
            disparity = self.regression(logits, distribution.values)
            predictions = (
                *self._scales(by_attention, weights, Distribution(attention, STRIDE, float(STRIDE))),
                *self._scales(disparity, weights, distribution),
            )
            return StereoOutput(predictions[-1].disparity, predictions)
        disparity, confidence = self.regression.with_confidence(logits, distribution.values)
        fine = self.upsampler(disparity, guides)
        return StereoOutput(fine, (Prediction(fine, 1, distribution),), bilinear_upsample(confidence, STRIDE))

    def _scales(self, disparity: Tensor, weights: Tensor, distribution: Distribution) -> tuple[Prediction, Prediction]:
        """A disparity as it is, and at full resolution."""
        fine = superpixel_upsample(disparity, weights, padding=self.upsampler.padding)
        return Prediction(disparity, STRIDE, distribution), Prediction(fine, 1, distribution)


@MODELS.register("fast_acvnet")
class FastACVNet(FastACVNetPlus):
    """Fast-ACVNet+ with an attention at stride 8, which neighbours then propagate at stride 4.

    Args:
        arguments: those of `FastACVNetPlus`.

    >>> model = FastACVNet(max_disparity=96).eval()
    >>> model(*torch.rand(2, 1, 3, 50, 70)).disparity.shape
    torch.Size([1, 50, 70])
    """

    stem_channels = (*STEM_CHANNELS, 32)
    attention_of = PropagatedAttention


def _merge(published: str, ours: str) -> KeyMap:
    """What follows the skip of an up step."""
    return KeyMap(
        [
            *layer(f"{published}0.", f"{ours}merge."),
            *layer(f"{published}1.", f"{ours}convs.0."),
            *layer(f"{published}2.", f"{ours}convs.1."),
        ]
    )


def _small_hourglass(stride: int) -> KeyMap:
    """An hourglass of two halvings, at half of its own stride in the beginning."""
    return KeyMap(
        [
            *PAIR.under("conv{n}.", "down{n}.convs."),
            *EXCITED.under(f"feature_att_{2 * stride}.", "down1.guidance."),
            *EXCITED.under(f"feature_att_{4 * stride}.", "down2.guidance."),
            *layer("conv2_up.", "up2.up."),
            *_merge("agg.", "up2."),
            *EXCITED.under(f"feature_att_up_{2 * stride}.", "up2.guidance."),
        ]
    )


KEYS = (
    *MOBILENET.under("feature.", "backbone.encoder."),
    *DECODER.under("feature_up.", "backbone."),
    *STEMS.under("", "backbone."),
    *layer("concat_feature.0.", "cost.projection.layers.0."),
    ("concat_feature.1.", "cost.projection.layers.1."),
    *layer("concat_stem.", "aggregation.stem."),
    *EXCITED.under("concat_feature_att_4.", "aggregation.stem_guidance."),
    *_small_hourglass(4).under("hourglass.", "aggregation."),
    ("hourglass.conv1_up.conv.", "aggregation.up1."),
    *SUPERPIXELS.under("", "upsampler."),
)
AUTHORS: dict[str, Any] = {
    "source": "the authors' checkpoints",
    "licence": "MIT",
    "overrides": {"padding": "zeros", "corner": "top_right", "superpixel_padding": "zeros"},
}

publish(
    "fast_acvnet_plus",
    unused=("hourglass.conv1_up.bn.", "hourglass_att.conv1_up.bn."),
    keys=[
        *KEYS,
        *layer("conv.", "attention.cost.projection.layers.0."),
        ("desc.", "attention.cost.projection.layers.1."),
        *layer("corr_stem.", "attention.aggregation.stem."),
        *EXCITED.under("corr_feature_att_4.", "attention.aggregation.stem_guidance."),
        *PAIR.under("hourglass_att.conv{n}.", "attention.aggregation.down{n}.convs."),
        *EXCITED.under("hourglass_att.feature_att_8.", "attention.aggregation.down1.guidance."),
        *EXCITED.under("hourglass_att.feature_att_16.", "attention.aggregation.down2.guidance."),
        *EXCITED.under("hourglass_att.feature_att_32.", "attention.aggregation.down3.guidance."),
        ("hourglass_att.conv1_up.conv.", "attention.aggregation.up1."),
        *layer("hourglass_att.conv{n}_up.", "attention.aggregation.up{n}.up."),
        *_merge("hourglass_att.agg_0.", "attention.aggregation.up3."),
        *_merge("hourglass_att.agg_1.", "attention.aggregation.up2."),
        *EXCITED.under("hourglass_att.feature_att_up_16.", "attention.aggregation.up3.guidance."),
        *EXCITED.under("hourglass_att.feature_att_up_8.", "attention.aggregation.up2.guidance."),
    ],
    **AUTHORS,
)
publish(
    "fast_acvnet",
    unused=("hourglass.conv1_up.bn.",),
    keys=[
        *KEYS,
        ("beta", "attention.propagation.bias"),
        ("gamma", "attention.propagation.slope"),
        ("patch.", "attention.aggregation.smooth."),
        *EXCITED.under("corr_feature_att_8.", "attention.aggregation.stem_guidance."),
        *_small_hourglass(8).under("hourglass_att.", "attention.aggregation."),
        *layer("hourglass_att.conv1_up_.", "attention.aggregation.up1."),
        ("hourglass_att.conv_final.", "attention.aggregation.head."),
    ],
    **AUTHORS,
)
