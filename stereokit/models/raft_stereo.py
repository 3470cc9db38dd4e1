"""RAFT-Stereo: a disparity that a recurrent unit mends, again and again, by what it looks up in the correlation.

Lipson et al., "RAFT-Stereo: multilevel recurrent field transforms for stereo matching", 3DV 2021. It has no slots.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from stereokit.config import Corner, Padding, Statistics
from stereokit.contracts import Prediction, StereoOutput
from stereokit.costs.pair_lookup import Lookup, PairLookup
from stereokit.layers import at_least_float32
from stereokit.models.recurrent import (
    ALIASES,
    BLOCK,
    HIDDEN,
    TRUNK,
    UNITS,
    ContextHeads,
    RecurrentNetwork,
    Trunk,
    Update,
    block,
)
from stereokit.network import Preprocessing
from stereokit.registry import MODELS
from stereokit.upsampling.convex import ConvexWeights
from stereokit.upsampling.superpixel import superpixel_upsample
from stereokit.weights.key_map import publish

__all__ = ["RAFTStereo", "RAFTStereoRealtime"]


class Encoded(NamedTuple):
    """What stays the same in all iterations."""

    left: Tensor
    right: Tensor
    states: list[Tensor]
    contexts: list[Sequence[Tensor]]


@MODELS.register("raft_stereo")
class RAFTStereo(RecurrentNetwork):
    """Three recurrent units of strides 4 to 16 mend a disparity that begins at 0.

    In training mode there is a prediction after each iteration, with weights that grow to 1; in eval mode the last one
    alone. Batch norms stay as they are, in training too, as the authors had it. Nothing flows back from an iteration to
    the one before but through the states.

    There is no distribution over disparities, and so no confidence, and no largest disparity: `max_disparity` is what
    tiles and errors reckon with.

    Args:
        max_disparity: in px, see above.
        iterations: in training mode.
        test_iterations: in eval mode; more take longer, and mend more.
        lookup: "volume", "on_demand" or "auto", see `PairLookup`.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: fewer than one iteration, another form of the lookup, or another preprocessing.

    Source: Lipson et al., "RAFT-Stereo: multilevel recurrent field transforms for stereo matching", 3DV 2021.

    >>> model = RAFTStereo(test_iterations=2).eval()
    >>> model(*torch.rand(2, 1, 3, 40, 70)).disparity.shape
    torch.Size([1, 40, 70])
    """

    stride = 4
    levels = 3
    shared_trunk = False

    def __init__(
        self,
        *,
        max_disparity: int = 192,
        iterations: int = 22,
        test_iterations: int = 32,
        lookup: Lookup = "auto",
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
            # the coarsest level of the pyramid has a column
            least_size=8 * self.stride,
            preprocessing=Preprocessing(mean=mean, std=std, statistics=statistics, padding=padding, corner=corner),
        )
        self.trunk = Trunk(stride=self.stride, norm="batch")
        self.context = ContextHeads(levels=self.levels)
        self.features = (
            nn.Sequential(block(128, 128, norm="instance"), nn.Conv2d(128, 256, 3, padding=1))
            if self.shared_trunk
            else nn.Sequential(Trunk(stride=self.stride, norm="instance"), nn.Conv2d(128, 256, 1))
        )
        self.lookup = PairLookup(levels=4, radius=4, form=lookup)
        self.update = Update(levels=self.levels, looked_up=self.lookup.out_channels, coarse_twice=self.shared_trunk)
        self.upsampling = ConvexWeights(HIDDEN, self.stride)

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Images, normalised and padded, to the output."""
        of_left, of_right, states, contexts = self._encode(left, right)
        pairs = self.lookup.of(of_left, of_right)
        flow = torch.zeros_like(of_left[:, :2], dtype=torch.float32)
        predictions = []
        for iteration in range(self.rounds):
            flow = flow.detach()
            # disparity is flow to the left
            looked_up = self.lookup(pairs, -flow[:, 0])
            states, change = self.update(states, contexts, looked_up.to(of_left.dtype), flow.to(of_left.dtype))
            along_rows = flow[:, :1] + at_least_float32(change[:, :1])
            flow = torch.cat((along_rows, torch.zeros_like(along_rows)), dim=1)
            if self.training or iteration == self.rounds - 1:
                predictions.append(Prediction(self._upsampled(-along_rows.squeeze(1), states[0])))
        return StereoOutput(predictions[-1].disparity, tuple(predictions))

    def _encode(self, left: Tensor, right: Tensor) -> Encoded:
        both = torch.cat((left, right))
        if self.shared_trunk:
            maps = self.trunk(both)
            of_left, of_right = self.features(maps).chunk(2)
            return Encoded(of_left, of_right, *self.context(maps.chunk(2)[0]))
        of_left, of_right = self.features(both).chunk(2)
        return Encoded(of_left, of_right, *self.context(self.trunk(left)))

    def _upsampled(self, disparity: Tensor, state: Tensor) -> Tensor:
        return superpixel_upsample(self.stride * disparity, self.upsampling(state), padding="zeros")


@MODELS.register("raft_stereo_realtime")
class RAFTStereoRealtime(RAFTStereo):
    """RAFT-Stereo with two recurrent units of strides 8 and 16, one trunk for both views, and few iterations.

    Args:
        max_disparity: in px, see `RAFTStereo`.
        iterations: in training mode.
        test_iterations: in eval mode.
        lookup: "volume", "on_demand" or "auto", see `PairLookup`.
        mean, std, statistics, padding, corner: see `Preprocessing`.

    Raises:
        ConfigError: fewer than one iteration, another form of the lookup, or another preprocessing.

    Source: Lipson et al., "RAFT-Stereo", 3DV 2021, section 3.5.

    >>> RAFTStereoRealtime(test_iterations=2).eval()(*torch.rand(2, 1, 3, 70, 80)).disparity.shape
    torch.Size([1, 70, 80])
    """

    stride = 8
    levels = 2
    shared_trunk = True

    def __init__(
        self,
        *,
        max_disparity: int = 192,
        iterations: int = 22,
        test_iterations: int = 7,
        lookup: Lookup = "auto",
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
            lookup=lookup,
            mean=mean,
            std=std,
            statistics=statistics,
            padding=padding,
            corner=corner,
        )


KEYS = (
    *TRUNK.under("cnet.", "trunk."),
    *BLOCK.under("cnet.layer4.{m}.", "context.down.0.{m}."),
    *BLOCK.under("cnet.outputs08.0.0.", "context.state.0.0."),
    *BLOCK.under("cnet.outputs08.1.0.", "context.context.0.0."),
    *BLOCK.under("cnet.outputs16.0.0.", "context.state.1.0."),
    *BLOCK.under("cnet.outputs16.1.0.", "context.context.1.0."),
    ("cnet.outputs08.0.1.", "context.state.0.1."),
    ("cnet.outputs08.1.1.", "context.context.0.1."),
    ("cnet.outputs16.0.1.", "context.state.1.1."),
    ("cnet.outputs16.1.1.", "context.context.1.1."),
    ("context_zqr_convs.", "context.gates."),
    ("update_block.encoder.convc1.", "update.motion.correlation.0."),
    ("update_block.encoder.convc2.", "update.motion.correlation.2."),
    ("update_block.encoder.convf1.", "update.motion.flow.0."),
    ("update_block.encoder.convf2.", "update.motion.flow.2."),
    ("update_block.encoder.conv.", "update.motion.merge.0."),
    *UNITS.under("update_block.gru08.", "update.units.0."),
    *UNITS.under("update_block.gru16.", "update.units.1."),
    ("update_block.flow_head.conv1.", "update.head.0."),
    ("update_block.flow_head.conv2.", "update.head.2."),
    ("update_block.mask.", "upsampling.layers."),
)
publish(
    "raft_stereo",
    source="the authors' checkpoints",
    licence="MIT",
    unused=ALIASES,
    keys=[
        *KEYS,
        *BLOCK.under("cnet.layer5.{m}.", "context.down.1.{m}."),
        ("cnet.outputs32.0.", "context.state.2.0."),
        ("cnet.outputs32.1.", "context.context.2.0."),
        *UNITS.under("update_block.gru32.", "update.units.2."),
        *TRUNK.under("fnet.", "features.0."),
        ("fnet.conv2.", "features.1."),
    ],
)
publish(
    "raft_stereo_realtime",
    source="the authors' checkpoints",
    licence="MIT",
    # a third level that only the other form has
    unused=(*ALIASES, "cnet.layer5.", "cnet.outputs32.", "update_block.gru32."),
    keys=[*KEYS, *BLOCK.under("conv2.0.", "features.0."), ("conv2.1.", "features.1.")],
)
