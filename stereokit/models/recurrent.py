"""What RAFT-Stereo and the networks after it share: recurrent units at several strides that mend a disparity."""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.config import NetworkConfig
from stereokit.errors import ConfigError
from stereokit.layers import ConvGRU, ConvNormAct, Norm, ResidualBlock, relu
from stereokit.network import MIN_SIZE, Preprocessing, StereoNetwork
from stereokit.weights.key_map import KeyMap

__all__ = ["HIDDEN", "ContextHeads", "RecurrentNetwork", "Trunk", "Update", "block"]

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


class RecurrentNetwork(StereoNetwork):
    """A network that mends a disparity in rounds, and gives one after each of them in training mode.

    2D batch norms stay as they are, in training too, as the authors of these networks have it.

    Args:
        max_disparity: D, in px.
        iterations: in training mode.
        test_iterations: in eval mode.
        preprocessing: normalisation and padding.
        least_size: height and width that images have at least.
        first_weights: in the loss, of the predictions ahead of the rounds.

    Raises:
        ConfigError: fewer than one iteration.
    """

    def __init__(
        self,
        *,
        max_disparity: int,
        iterations: int,
        test_iterations: int,
        preprocessing: Preprocessing,
        least_size: int = MIN_SIZE,
        first_weights: Sequence[float] = (),
    ) -> None:
        _check_count("iterations", iterations)
        # from 0.9^15, however many there are, to 1
        decay = 0.9 ** (15 / max(iterations - 1, 1))
        super().__init__(
            max_disparity=max_disparity,
            multiple=32,
            least_size=least_size,
            loss_weights=(*first_weights, *(decay ** (iterations - 1 - i) for i in range(iterations))),
            preprocessing=preprocessing,
        )
        self.iterations = iterations
        self.test_iterations = test_iterations

    @property
    def test_iterations(self) -> int:
        """The iterations of eval mode, which can be set: more take longer, and mend more.

        Raises:
            ConfigError: fewer than one.
        """
        return self._test_iterations

    @test_iterations.setter
    def test_iterations(self, count: int) -> None:
        _check_count("test_iterations", count)
        self._test_iterations = count

    @property
    def config(self) -> NetworkConfig:
        """What rebuilds the network, with the iterations that it has now."""
        return {**super().config, "test_iterations": self.test_iterations}

    @property
    def rounds(self) -> int:
        """The iterations of this mode."""
        return self.iterations if self.training else self.test_iterations

    def train(self, mode: bool = True) -> "RecurrentNetwork":
        """Sets the mode; 2D batch norms stay in eval mode."""
        super().train(mode)
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.eval()
        return self


def _check_count(name: str, count: object) -> None:
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise ConfigError(f"{name}={count!r} has to be a whole number from 1 up")


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

UNITS = KeyMap([("convz.", "update."), ("convr.", "reset."), ("convq.", "candidate.")])
"""The gates of a unit."""

# the norm of a shortcut stands twice; the one that its authors load last is read
ALIASES = ("cnet.layer{n}.{m}.norm3.",)
