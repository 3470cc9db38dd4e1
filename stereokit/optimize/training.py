"""Memory formats and types for training."""

import copy
from itertools import chain
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from stereokit.errors import ConfigError

__all__ = [
    "ApartFromAutocast",
    "SmallConv3d",
    "SmallConvTranspose3d",
    "StridedDepthwise",
    "copy_state",
    "prepare_for_training",
]

Network = TypeVar("Network", bound=nn.Module)


class ApartFromAutocast(nn.Module):
    """A convolution that a CPU's autocast leaves in the type of its weights, float32 as a rule, where `stays_out`."""

    weight: Tensor

    def stays_out(self, x: Tensor) -> bool:
        """Whether the convolution of x is one that autocast is to leave alone."""
        raise NotImplementedError

    def forward(self, input: Tensor, *args: Any, **options: Any) -> Tensor:
        """The convolution of the input, in the type that autocast gives its results."""
        if input.device.type != "cpu" or not torch.is_autocast_enabled("cpu") or not self.stays_out(input):
            return super().forward(input, *args, **options)
        with torch.autocast("cpu", enabled=False):
            y = super().forward(input.to(self.weight.dtype), *args, **options)
        return y.to(torch.get_autocast_dtype("cpu"))


class StridedDepthwise(ApartFromAutocast, nn.Conv2d):
    """A depthwise convolution with a stride, which stays out of a CPU's autocast.

    oneDNN has no fast kernel for the gradient of its input in bfloat16, only one that takes ten times as long.

    >>> conv = StridedDepthwise(8, 8, 3, stride=2, padding=1, groups=8)
    >>> with torch.autocast("cpu", torch.bfloat16):
    ...     conv(torch.rand(1, 8, 6, 6)).dtype
    torch.bfloat16
    """

    def stays_out(self, x: Tensor) -> bool:
        """Always."""
        return True


class _SmallVolume(ApartFromAutocast):
    kernel_size: tuple[int, ...]

    def stays_out(self, x: Tensor) -> bool:
        """Where x is smaller than the kernel in depth, height or width."""
        return any(size < kernel for size, kernel in zip(x.shape[-3:], self.kernel_size, strict=True))


class SmallConv3d(_SmallVolume, nn.Conv3d):
    """A 3D convolution that keeps volumes smaller than its kernel out of a CPU's autocast.

    oneDNN takes the gradient of their weights in bfloat16 in part from memory that nobody wrote to, or writes beyond
    its own (seen with PyTorch 2.15 on AVX-512, for kernels of 3 to 5).

    >>> with torch.autocast("cpu", torch.bfloat16):
    ...     SmallConv3d(8, 8, 3, padding=1)(torch.rand(1, 8, 2, 6, 6)).dtype
    torch.bfloat16
    """


class SmallConvTranspose3d(_SmallVolume, nn.ConvTranspose3d):
    """A transposed 3D convolution that does the same as `SmallConv3d`."""


_SUBSTITUTES = {nn.Conv3d: SmallConv3d, nn.ConvTranspose3d: SmallConvTranspose3d}


def prepare_for_training(model: Network) -> Network:
    """A twin of a network that trains faster: its modules are copies, its parameters and buffers are the network's own.

    The weights of 3D, of depthwise and of 1 x 1 convolutions are put into channels-last memory formats. Their values,
    names and gradients stay, and so do optimisers and checkpoints: only the order in memory changes. Under a CPU's
    autocast strided depthwise convolutions and small volumes stay in float32: in the twin the former are
    `StridedDepthwise`, 3D convolutions `SmallConv3d` and `SmallConvTranspose3d`. Results differ by rounding.

    What the twin learns, the network knows too, as long as both share their tensors. A twin that moves to another
    device gets buffers of its own there: `copy_state` brings them back.

    Args:
        model: keeps its classes, hooks and names; its weights change their order in memory.

    Raises:
        ConfigError: the network can't be copied.

    >>> network = nn.Sequential(nn.Conv3d(2, 2, 3))
    >>> twin = prepare_for_training(network)
    >>> type(network[0]).__name__, type(twin[0]).__name__, twin[0].weight is network[0].weight
    ('Conv3d', 'SmallConv3d', True)
    >>> network[0].weight.is_contiguous(memory_format=torch.channels_last_3d)
    True
    """
    shared = {id(tensor): tensor for tensor in chain(model.parameters(), model.buffers())}
    try:
        # what deepcopy finds in its memo it takes for copied already
        twin = copy.deepcopy(model, dict(shared))
    except RuntimeError as error:
        reason = str(error).strip().split("\n")[0]
        raise ConfigError(
            f"a {type(model).__name__} can't be copied to be made ready for training ({reason}); make weights that are "
            "computed from others by torch.nn.utils.parametrizations"
        ) from error
    for module in twin.modules():
        if isinstance(module, nn.Conv3d | nn.ConvTranspose3d):
            module.to(memory_format=torch.channels_last_3d)
            module.__class__ = _SUBSTITUTES.get(type(module), type(module))
        elif isinstance(module, nn.Conv2d):
            depthwise = module.groups == module.in_channels > 1
            if depthwise or module.kernel_size == (1, 1):
                module.to(memory_format=torch.channels_last)
            if depthwise and module.stride != (1, 1) and type(module) is nn.Conv2d:
                module.__class__ = StridedDepthwise
    return twin


@torch.no_grad()
def copy_state(twin: nn.Module, model: nn.Module) -> None:
    """Gives a network what its twin learnt: the values of all parameters and buffers that are not shared any more.

    Args:
        twin: of `prepare_for_training`, on any device.
        model: the network that it was made from.

    >>> network = nn.BatchNorm2d(2)
    >>> twin = prepare_for_training(network)
    >>> twin.running_mean = torch.ones(2)
    >>> copy_state(twin, network)
    >>> network.running_mean
    tensor([1., 1.])
    """
    theirs = chain(twin.parameters(), twin.buffers())
    for mine, new in zip(chain(model.parameters(), model.buffers()), theirs, strict=True):
        if mine is not new:
            mine.copy_(new)
