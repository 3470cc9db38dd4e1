"""RAFT-Stereo: a disparity that a recurrent unit mends, again and again, by what it looks up in the correlation.

Lipson et al., "RAFT-Stereo: multilevel recurrent field transforms for stereo matching", 3DV 2021. It has no slots.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.config import Corner, Padding, Statistics
from stereokit.contracts import Prediction, StereoOutput
from stereokit.costs.pair_lookup import Lookup, PairLookup
from stereokit.errors import ConfigError
from stereokit.layers import ConvGRU, ConvNormAct, Norm, ResidualBlock, at_least_float32, relu
from stereokit.network import Preprocessing, StereoNetwork
from stereokit.registry import MODELS
from stereokit.upsampling.convex import ConvexWeights
from stereokit.upsampling.superpixel import superpixel_upsample
from stereokit.weights.key_map import KeyMap, publish

__all__ = ["RAFTStereo", "RAFTStereoRealtime"]

HIDDEN = 128
"""Channels of the states, and of the contexts."""

block = partial(ResidualBlock, activation=relu, last_activation=relu, after_sum=relu, bias=True)


def blocks(in_channels: int, out_channels: int, *, stride: int, norm: Norm) -> nn.Sequential:
    return nn.Sequential(
        block(in_channels, out_channels, stride=stride, norm=norm), block(out_channels, out_channels, norm=norm)
    )


class Trunk(nn.Module):
    """A convolution and six residual blocks, down to stride 4 or 8.

    Args:
        stride: of the output; the first convolution halves the size where it is 8.
        norm: of all layers.
    """

    def __init__(self, *, stride: int, norm: Norm) -> None:
        super().__init__()
        self.stem = ConvNormAct(3, 64, 7, stride=stride // 4, bias=True, norm=norm, activation=relu)
        self.layer1 = blocks(64, 64, stride=1, norm=norm)
        self.layer2 = blocks(64, 96, stride=2, norm=norm)
        self.layer3 = blocks(96, 128, stride=2, norm=norm)

    def forward(self, images: Tensor) -> Tensor:
        """(B, 3, H, W) to (B, 128, H / stride, W / stride)."""
        x: Tensor = self.layer3(self.layer2(self.layer1(self.stem(images))))
        return x


class ContextHeads(nn.Module):
    """The first state of each level, and what is added to the gates of its unit in every iteration.

    Args:
        levels: 2 or 3, each half as fine as the one before.
    """

    def __init__(self, *, levels: int) -> None:
        super().__init__()
        self.down = nn.ModuleList(blocks(128, 128, stride=2, norm="batch") for _ in range(levels - 1))
        self.state, self.context = (
            nn.ModuleList(self._head(plain=level == 2) for level in range(levels)) for _ in range(2)
        )
        self.gates = nn.ModuleList(nn.Conv2d(HIDDEN, 3 * HIDDEN, 3, padding=1) for _ in range(levels))

    @staticmethod
    def _head(*, plain: bool) -> nn.Sequential:
        last = nn.Conv2d(128, HIDDEN, 3, padding=1)
        return nn.Sequential(last) if plain else nn.Sequential(block(128, 128), last)

    def forward(self, x: Tensor) -> tuple[list[Tensor], list[Sequence[Tensor]]]:
        """(B, 128, h, w) to states and contexts, the finest first."""
        states, contexts = [], []
        for level, (state, context, gates) in enumerate(zip(self.state, self.context, self.gates, strict=True)):
            x = self.down[level - 1](x) if level else x
            states.append(torch.tanh(state(x)))
            contexts.append(gates(F.relu(context(x))).chunk(3, dim=1))
        return states, contexts


class MotionEncoder(nn.Module):
    """What was looked up, and where, to the input of the finest unit.

    Args:
        looked_up: channels of what was looked up.
        flow: channels of where.
        channels: of the output, those of the flow included.
    """

    def __init__(self, looked_up: int, *, flow: int, channels: int) -> None:
        super().__init__()
        self.correlation = nn.Sequential(nn.Conv2d(looked_up, 64, 1), relu(), nn.Conv2d(64, 64, 3, padding=1), relu())
        self.flow = nn.Sequential(nn.Conv2d(flow, 64, 7, padding=3), relu(), nn.Conv2d(64, 64, 3, padding=1), relu())
        self.merge = nn.Sequential(nn.Conv2d(128, channels - flow, 3, padding=1), relu())

    def forward(self, looked_up: Tensor, flow: Tensor) -> Tensor:
        """Correlation (B, ., h, w) and flow (B, ., h, w) to (B, channels, h, w)."""
        merged = self.merge(torch.cat((self.correlation(looked_up), self.flow(flow)), dim=1))
        return torch.cat((merged, flow), dim=1)


class Update(nn.Module):
    """One iteration of all units, from coarse to fine: each sees its neighbours.

    Args:
        levels: how many units there are, from 1 to 3.
        looked_up: channels of what was looked up.
        flow: channels of what is mended: 2 along rows and columns, 1 along rows alone.
        hidden: channels of the states.
        head: channels between the two convolutions that give the change.
        coarse_twice: the coarse units take a step of their own ahead of the common one.
    """

    def __init__(
        self,
        *,
        levels: int,
        looked_up: int,
        flow: int = 2,
        hidden: int = HIDDEN,
        head: int = 256,
        coarse_twice: bool = False,
    ) -> None:
        super().__init__()
        self.coarse_twice = coarse_twice
        self.motion = MotionEncoder(looked_up, flow=flow, channels=hidden)
        neighbors = [(level > 0) + (level < levels - 1) for level in range(levels)]
        self.units = nn.ModuleList(
            ConvGRU(hidden, hidden * (count + (level == 0))) for level, count in enumerate(neighbors)
        )
        self.head = nn.Sequential(
            nn.Conv2d(hidden, head, 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(head, flow, 3, padding=1)
        )

    def forward(
        self, states: Sequence[Tensor], contexts: Sequence[Sequence[Tensor]], looked_up: Tensor, flow: Tensor
    ) -> tuple[list[Tensor], Tensor]:
        """States, the finest first, to the next ones and a change of the flow, of its shape."""
        states = list(states)
        coarse = range(len(self.units) - 1, 0, -1)
        for level in (*coarse, *coarse) if self.coarse_twice else coarse:
            states[level] = self.units[level](states[level], contexts[level], *self._neighbors(states, level))
        motion = self.motion(looked_up, flow)
        states[0] = self.units[0](states[0], contexts[0], motion, *self._neighbors(states, 0))
        return states, self.head(states[0])

    @staticmethod
    def _neighbors(states: Sequence[Tensor], level: int) -> list[Tensor]:
        inputs = [F.avg_pool2d(states[level - 1], 3, stride=2, padding=1)] if level else []
        if level + 1 < len(states):
            size = states[level].shape[-2:]
            inputs.append(F.interpolate(states[level + 1], size=size, mode="bilinear", align_corners=True))
        return inputs


def check_iterations(**counts: int) -> None:
    """Raises `ConfigError` unless all of them are whole numbers from 1 up."""
    for name, count in counts.items():
        if isinstance(count, bool) or not isinstance(count, int) or count < 1:
            raise ConfigError(f"{name}={count!r} has to be a whole number from 1 up")


def growing_weights(iterations: int) -> tuple[float, ...]:
    """The weight in the loss of what each iteration gives: from 0.9^15, however many there are, to 1."""
    decay = 0.9 ** (15 / max(iterations - 1, 1))
    return tuple(decay ** (iterations - 1 - i) for i in range(iterations))


def keep_batch_norms(network: nn.Module) -> None:
    """Has the 2D batch norms of a network stay as they are, in training mode too."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()


class Encoded(NamedTuple):
    """What stays the same in all iterations."""

    left: Tensor
    right: Tensor
    states: list[Tensor]
    contexts: list[Sequence[Tensor]]


@MODELS.register("raft_stereo")
class RAFTStereo(StereoNetwork):
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
        check_iterations(iterations=iterations, test_iterations=test_iterations)
        super().__init__(
            max_disparity=max_disparity,
            multiple=32,
            # the coarsest level of the pyramid has a column
            least_size=8 * self.stride,
            loss_weights=growing_weights(iterations),
            preprocessing=Preprocessing(mean=mean, std=std, statistics=statistics, padding=padding, corner=corner),
        )
        self.iterations = iterations
        self.test_iterations = test_iterations
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

    def train(self, mode: bool = True) -> "RAFTStereo":
        """Sets the mode; batch norms stay in eval mode."""
        super().train(mode)
        keep_batch_norms(self)
        return self

    def match(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Images, normalised and padded, to the output."""
        of_left, of_right, states, contexts = self._encode(left, right)
        pairs = self.lookup.of(of_left, of_right)
        flow = torch.zeros_like(of_left[:, :2], dtype=torch.float32)
        predictions = []
        count = self.iterations if self.training else self.test_iterations
        for iteration in range(count):
            flow = flow.detach()
            # disparity is flow to the left
            looked_up = self.lookup(pairs, -flow[:, 0])
            states, change = self.update(states, contexts, looked_up.to(of_left.dtype), flow.to(of_left.dtype))
            along_rows = flow[:, :1] + at_least_float32(change[:, :1])
            flow = torch.cat((along_rows, torch.zeros_like(along_rows)), dim=1)
            if self.training or iteration == count - 1:
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


BLOCK = KeyMap(
    [
        ("conv1.", "conv1.0."),
        ("norm1.", "conv1.1."),
        ("conv2.", "conv2.0."),
        ("norm2.", "conv2.1."),
        ("downsample.", "skip."),
    ]
)

TRUNK = KeyMap(
    [
        ("conv1.", "stem.0."),
        ("norm1.", "stem.1."),
        *(pair for n in (1, 2, 3) for pair in BLOCK.under(f"layer{n}.{{m}}.", f"layer{n}.{{m}}.")),
    ]
)

UNITS = (("convz.", "update."), ("convr.", "reset."), ("convq.", "candidate."))

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
    *KeyMap(UNITS).under("update_block.gru08.", "update.units.0."),
    *KeyMap(UNITS).under("update_block.gru16.", "update.units.1."),
    ("update_block.flow_head.conv1.", "update.head.0."),
    ("update_block.flow_head.conv2.", "update.head.2."),
    ("update_block.mask.", "upsampling.layers."),
)
# the norm of a shortcut stands twice; the one that its authors load last is read
ALIASES = ("cnet.layer{n}.{m}.norm3.",)

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
        *KeyMap(UNITS).under("update_block.gru32.", "update.units.2."),
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
