"""IGEV-Stereo and RT-IGEV: a guided volume gives a first disparity, and is looked up where recurrent units mend it.

Xu et al., "Iterative geometry encoding volume for stereo matching", CVPR 2023; "IGEV++: iterative multi-range geometry
encoding volumes for stereo matching", TPAMI 2025, whose real-time network RT-IGEV is.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from stereokit.aggregation.hourglass import VolumeHourglass
from stereokit.backbones.unet import UNet
from stereokit.checks import check_max_disparity
from stereokit.config import Corner, Padding, Statistics
from stereokit.contracts import Distribution, Guides, Prediction, StereoOutput
from stereokit.costs import groupwise_correlation_volume
from stereokit.costs.pair_lookup import Lookup, PairLookup
from stereokit.costs.volume_lookup import VolumeLookup, volume_pyramid
from stereokit.guidance import GCE
from stereokit.layers import ConvNormAct, at_least_float32, init_convolutions
from stereokit.models.coex import MOBILENET, PAIR
from stereokit.models.recurrent import (
    ALIASES,
    BLOCK,
    TRUNK,
    UNITS,
    ContextHeads,
    RecurrentNetwork,
    Trunk,
    Update,
)
from stereokit.network import Preprocessing
from stereokit.registry import MODELS
from stereokit.regression import soft_argmin
from stereokit.upsampling.superpixel import SuperpixelUpsampler, superpixel_upsample
from stereokit.weights.key_map import KeyMap, layer, publish

__all__ = ["IGEV", "RTIGEV"]

STRIDE = 4

GROUPS = 8


class StateSuperpixels(nn.Module):
    """The weights of each pixel's 3x3 coarse neighbours, from a state at stride 4 and a guide at 2.

    Args:
        in_channels: of the state.
        guide_channels: of the guide.
    """

    def __init__(self, in_channels: int, guide_channels: int) -> None:
        super().__init__()
        self.stem = nn.Sequential(nn.Conv2d(in_channels, 32, 3, padding=1), nn.ReLU(inplace=True))
        self.up = ConvNormAct(32, 32, 4, stride=2, transposed=True)
        self.merge = ConvNormAct(32 + guide_channels, 32 + guide_channels)
        self.head = nn.ConvTranspose2d(32 + guide_channels, 9, 4, stride=2, padding=1)
        init_convolutions(self.head)

    def forward(self, state: Tensor, guide: Tensor) -> Tensor:
        """(B, in_channels, h, w) and (B, guide_channels, 2h, 2w) to (B, 9, 4h, 4w)."""
        x = self.merge(torch.cat((self.up(self.stem(state)), guide), dim=1))
        return at_least_float32(self.head(x)).softmax(1)


class _IGEV(RecurrentNetwork):
    """What both networks share: features, geometry encoding volume, first disparity, iterations."""

    update: Update

    def __init__(
        self,
        *,
        max_disparity: int,
        iterations: int,
        test_iterations: int,
        pretrained_backbone: bool,
        stem: bool,
        hidden: int,
        preprocessing: Preprocessing,
    ) -> None:
        check_max_disparity(max_disparity, 8 * STRIDE, "an hourglass of three halvings at stride 4")
        super().__init__(
            max_disparity=max_disparity,
            iterations=iterations,
            test_iterations=test_iterations,
            first_weights=(1.0,),
            preprocessing=preprocessing,
        )
        self.planes = max_disparity // STRIDE
        self.backbone = UNet(norm="instance", pretrained=pretrained_backbone)
        guides = self.backbone.info.guide_channels
        channels = guides[STRIDE]
        self.matching = nn.Sequential(
            ConvNormAct(channels, channels, norm="instance"), nn.Conv2d(channels, channels, 1)
        )
        self.geometry = VolumeHourglass(
            in_channels=GROUPS, out_channels=GROUPS, guidance=GCE, guide_channels=guides, stem=stem
        )
        self.classifier = nn.Conv3d(GROUPS, 1, 3, padding=1, bias=False)
        self.lookup = VolumeLookup(channels=GROUPS)
        self.superpixels = StateSuperpixels(hidden, guides[2])
        self.first_upsampler = SuperpixelUpsampler(
            scale=STRIDE, guide_channels={2: guides[2], STRIDE: channels}, padding="zeros", norm="instance"
        )

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Images, normalised and padded, to the output."""
        features = self.backbone(torch.cat((left, right)))
        guides = {stride: guide.chunk(2)[0] for stride, guide in features.guides.items()}
        of_left, of_right = self.matching(features.matching[STRIDE]).chunk(2)

        # the geometry encoding volume, and a first disparity
        volume = self.geometry(groupwise_correlation_volume(of_left, of_right, self.planes, GROUPS), guides)
        logits = self.classifier(volume).squeeze(1)
        disparity = soft_argmin(logits)
        predictions = []
        if self.training:
            distribution = Distribution(logits, STRIDE, float(STRIDE))
            first = self.first_upsampler(STRIDE * disparity, guides)
            predictions.append(Prediction(first, distribution=distribution))

        # mended, again and again
        states, contexts = self.begin(left, guides)
        pyramid = volume_pyramid(at_least_float32(volume), self.lookup.levels)
        look_up = self.looked_up_in(pyramid, of_left, of_right)
        for iteration in range(self.rounds):
            disparity = disparity.detach()
            around = look_up(disparity).to(left.dtype)
            states, change = self.update(states, contexts, around, disparity.unsqueeze(1).to(left.dtype))
            disparity = disparity + at_least_float32(change.squeeze(1))
            if self.training or iteration == self.rounds - 1:
                weights = self.superpixels(states[0], guides[2])
                predictions.append(Prediction(superpixel_upsample(STRIDE * disparity, weights, padding="zeros")))
        return StereoOutput(predictions[-1].disparity, tuple(predictions))

    def begin(self, left: Tensor, guides: Guides) -> tuple[list[Tensor], list[Sequence[Tensor]]]:
        """Image and guides to the first states, the finest first, and the contexts of their units."""
        raise NotImplementedError

    def looked_up_in(self, pyramid: list[Tensor], left: Tensor, right: Tensor) -> Callable[[Tensor], Tensor]:
        """What answers a disparity (B, h, w) with a map (B, ., h, w)."""
        raise NotImplementedError


@MODELS.register("rt_igev")
class RTIGEV(_IGEV):
    """RT-IGEV: CoEx's features and hourglass give a volume, in which one recurrent unit looks up what it mends.

    In training mode there is the first disparity and one after each iteration, with weights that grow to 1; in eval
    mode the last one alone. 2D batch norms stay as they are, in training too. Nothing flows back from an iteration to
    the disparity before.

    There is no distribution over disparities behind the last one, and so no confidence.

    Args:
        max_disparity: D, in px, of the volume; a multiple of 32. Estimates may lie beyond.
        iterations: in training mode.
        test_iterations: in eval mode.
        pretrained_backbone: load timm's weights for the encoder.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: another number of disparities, fewer than one iteration, or another preprocessing.

    Source: Xu et al., "IGEV++", TPAMI 2025: its real-time network.

    >>> RTIGEV(max_disparity=64, test_iterations=2).eval()(*torch.rand(2, 1, 3, 40, 70)).disparity.shape
    torch.Size([1, 40, 70])
    """

    def __init__(
        self,
        *,
        max_disparity: int = 192,
        iterations: int = 22,
        test_iterations: int = 8,
        pretrained_backbone: bool = False,
        mean: Sequence[float] = (0.5, 0.5, 0.5),
        std: Sequence[float] = (0.5, 0.5, 0.5),
        statistics: Statistics = "fixed",
        padding: Padding = "replicate",
        corner: Corner = "bottom_right",
    ) -> None:
        hidden = 96
        super().__init__(
            max_disparity=max_disparity,
            iterations=iterations,
            test_iterations=test_iterations,
            pretrained_backbone=pretrained_backbone,
            stem=False,
            hidden=hidden,
            preprocessing=Preprocessing(mean=mean, std=std, statistics=statistics, padding=padding, corner=corner),
        )
        self.state = nn.Sequential(ConvNormAct(96, 96), nn.Conv2d(96, hidden, 3, padding=1, bias=False))
        self.context = nn.Sequential(ConvNormAct(96, 96), nn.Conv2d(96, 3 * hidden, 3, padding=1))
        self.update = Update(levels=1, looked_up=self.lookup.out_channels, flow=1, hidden=hidden, head=128)

    def begin(self, left: Tensor, guides: Guides) -> tuple[list[Tensor], list[Sequence[Tensor]]]:
        """Guides to state and context."""
        map_ = guides[STRIDE]
        return [torch.tanh(self.state(map_))], [self.context(map_).chunk(3, dim=1)]

    def looked_up_in(self, pyramid: list[Tensor], left: Tensor, right: Tensor) -> Callable[[Tensor], Tensor]:
        """The volume alone."""
        return lambda disparity: self.lookup(pyramid, disparity)


@MODELS.register("igev")
class IGEV(_IGEV):
    """IGEV-Stereo: RT-IGEV's volume beside the correlation of all pairs, and RAFT-Stereo's three recurrent units.

    In training mode there is the first disparity and one after each iteration, with weights that grow to 1; in eval
    mode the last one alone. 2D batch norms stay as they are, in training too. Nothing flows back from an iteration to
    the disparity before.

    There is no distribution over disparities behind the last one, and so no confidence.

    Args:
        max_disparity: D, in px, of the volume; a multiple of 32. Estimates may lie beyond.
        iterations: in training mode.
        test_iterations: in eval mode.
        lookup: of the pairs: "volume", "on_demand" or "auto", see `PairLookup`.
        pretrained_backbone: load timm's weights for the encoder.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: another number of disparities, fewer than one iteration, another form of the lookup, or another
            preprocessing.

    Source: Xu et al., "Iterative geometry encoding volume for stereo matching", CVPR 2023.

    >>> IGEV(max_disparity=64, test_iterations=2).eval()(*torch.rand(2, 1, 3, 40, 70)).disparity.shape
    torch.Size([1, 40, 70])
    """

    def __init__(
        self,
        *,
        max_disparity: int = 192,
        iterations: int = 22,
        test_iterations: int = 32,
        lookup: Lookup = "auto",
        pretrained_backbone: bool = False,
        mean: Sequence[float] = (0.5, 0.5, 0.5),
        std: Sequence[float] = (0.5, 0.5, 0.5),
        statistics: Statistics = "fixed",
        padding: Padding = "replicate",
        corner: Corner = "bottom_right",
    ) -> None:
        super().__init__(
            max_disparity=max_disparity,
            iterations=iterations,
            test_iterations=test_iterations,
            pretrained_backbone=pretrained_backbone,
            stem=True,
            hidden=128,
            preprocessing=Preprocessing(mean=mean, std=std, statistics=statistics, padding=padding, corner=corner),
        )
        self.trunk = Trunk(stride=STRIDE, norm="batch")
        self.context = ContextHeads(levels=3)
        self.pair_lookup = PairLookup(levels=self.lookup.levels, radius=self.lookup.radius, form=lookup)
        self.update = Update(levels=3, looked_up=self.lookup.out_channels + self.pair_lookup.out_channels, flow=1)

    def begin(self, left: Tensor, guides: Guides) -> tuple[list[Tensor], list[Sequence[Tensor]]]:
        """The image to states and contexts."""
        states, contexts = self.context(self.trunk(left))
        return states, contexts

    def looked_up_in(self, pyramid: list[Tensor], left: Tensor, right: Tensor) -> Callable[[Tensor], Tensor]:
        """The volume, and the correlation of all pairs, level by level."""
        # not divided by the root of the channels here
        pairs = self.pair_lookup.of(left * left.shape[1] ** 0.5, right)

        def look_up(disparity: Tensor) -> Tensor:
            levels = self.lookup.levels
            volume = self.lookup(pyramid, disparity).chunk(levels, dim=1)
            correlation = self.pair_lookup(pairs, disparity).chunk(levels, dim=1)
            return torch.cat([part for both in zip(volume, correlation, strict=True) for part in both], dim=1)

        return look_up


GUIDE = KeyMap([*layer("feat_att.0.", "block.network.0."), ("feat_att.1.", "block.network.1.")])

KEYS = (
    *MOBILENET.under("feature.", "backbone.encoder."),
    ("feature.deconv{n}_{m}.conv1.conv.", "backbone.up_{m}.up.0."),
    ("feature.deconv{n}_{m}.conv2.conv.", "backbone.up_{m}.merge.0."),
    ("feature.conv4.conv.", "backbone.merge_4.0."),
    ("stem_{n}.0.conv.", "backbone.stem_{n}.0.0."),
    ("stem_{n}.1.", "backbone.stem_{n}.1.0."),
    ("conv.conv.", "matching.0.0."),
    ("desc.", "matching.1."),
    *PAIR.under("cost_agg.conv{n}.", "geometry.down{n}.convs."),
    ("cost_agg.conv1_up.conv.", "geometry.up1."),
    *layer("cost_agg.conv{n}_up.", "geometry.up{n}.up."),
    *(
        pair
        for theirs, ours in (("agg_0", "up3"), ("agg_1", "up2"))
        for pair in (
            *layer(f"cost_agg.{theirs}.0.", f"geometry.{ours}.merge."),
            *layer(f"cost_agg.{theirs}.1.", f"geometry.{ours}.convs.0."),
            *layer(f"cost_agg.{theirs}.2.", f"geometry.{ours}.convs.1."),
        )
    ),
    *GUIDE.under("cost_agg.feature_att_8.", "geometry.down1.guidance."),
    *GUIDE.under("cost_agg.feature_att_16.", "geometry.down2.guidance."),
    *GUIDE.under("cost_agg.feature_att_32.", "geometry.down3.guidance."),
    *GUIDE.under("cost_agg.feature_att_up_16.", "geometry.up3.guidance."),
    *GUIDE.under("cost_agg.feature_att_up_8.", "geometry.up2.guidance."),
    ("classifier.", "classifier."),
    ("spx_4.0.conv.", "first_upsampler.stem.0.0."),
    ("spx_4.1.", "first_upsampler.stem.1.0."),
    ("spx_2.conv1.conv.", "first_upsampler.up.0.0."),
    ("spx_2.conv2.conv.", "first_upsampler.merge.0.0."),
    ("spx.0.", "first_upsampler.head."),
    ("update_block.mask_feat_4.0.", "superpixels.stem.0."),
    *layer("spx_2_gru.conv1.", "superpixels.up."),
    *layer("spx_2_gru.conv2.", "superpixels.merge."),
    ("spx_gru.0.", "superpixels.head."),
    ("update_block.encoder.convc1.", "update.motion.correlation.0."),
    ("update_block.encoder.convc2.", "update.motion.correlation.2."),
    ("update_block.encoder.convd1.", "update.motion.flow.0."),
    ("update_block.encoder.convd2.", "update.motion.flow.2."),
    ("update_block.encoder.conv.", "update.motion.merge.0."),
    ("update_block.disp_head.conv1.", "update.head.0."),
    ("update_block.disp_head.conv2.", "update.head.2."),
)
UNREAD = ("cost_agg.conv1_up.bn.",)
AUTHORS: Mapping[str, Any] = {"source": "the authors' checkpoints", "licence": "MIT"}

publish(
    "rt_igev",
    unused=UNREAD,
    keys=[
        *KEYS,
        *layer("hnet.0.", "state.0."),
        ("hnet.1.", "state.1."),
        *layer("cnet.", "context.0."),
        ("context_zqr_conv.", "context.1."),
        *UNITS.under("update_block.gru.", "update.units.0."),
    ],
    **AUTHORS,
)
publish(
    "igev",
    unused=(*UNREAD, *ALIASES),
    keys=[
        *KEYS,
        *layer("corr_stem.", "geometry.stem."),
        *GUIDE.under("corr_feature_att.", "geometry.stem_guidance."),
        *TRUNK.under("cnet.", "trunk."),
        *BLOCK.under("cnet.layer4.{m}.", "context.down.0.{m}."),
        *BLOCK.under("cnet.layer5.{m}.", "context.down.1.{m}."),
        *(
            pair
            for level, stride in enumerate(("04", "08"))
            for which, head in enumerate(("state", "context"))
            for pair in (
                *BLOCK.under(f"cnet.outputs{stride}.{which}.0.", f"context.{head}.{level}.0."),
                (f"cnet.outputs{stride}.{which}.1.", f"context.{head}.{level}.1."),
            )
        ),
        ("cnet.outputs16.0.", "context.state.2.0."),
        ("cnet.outputs16.1.", "context.context.2.0."),
        ("context_zqr_convs.", "context.gates."),
        *UNITS.under("update_block.gru04.", "update.units.0."),
        *UNITS.under("update_block.gru08.", "update.units.1."),
        *UNITS.under("update_block.gru16.", "update.units.2."),
    ],
    **AUTHORS,
)
