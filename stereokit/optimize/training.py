"""Memory formats and types for training."""

from typing import TypeVar

import torch
from torch import Tensor, nn

__all__ = ["StridedDepthwise", "prepare_for_training"]

Network = TypeVar("Network", bound=nn.Module)


class StridedDepthwise(nn.Conv2d):
    """A depthwise convolution with a stride that a CPU's autocast leaves in the type of its weights, float32 as a rule.

    oneDNN has no fast kernel for the gradient of its input in bfloat16, only one that takes ten times as long.

    >>> conv = StridedDepthwise(8, 8, 3, stride=2, padding=1, groups=8)
    >>> with torch.autocast("cpu", torch.bfloat16):
    ...     conv(torch.rand(1, 8, 6, 6)).dtype
    torch.bfloat16
    """

    def forward(self, x: Tensor) -> Tensor:
        """The convolution of x."""
        if x.device.type != "cpu" or not torch.is_autocast_enabled("cpu"):
            return super().forward(x)
        with torch.autocast("cpu", enabled=False):
            y = super().forward(x.to(self.weight.dtype))
        return y.to(torch.get_autocast_dtype("cpu"))


def prepare_for_training(model: Network) -> Network:
    """Puts the weights of 3D, of depthwise and of 1 x 1 convolutions into channels-last memory formats.

    Their values, names and gradients stay, and so do optimisers and checkpoints: only the order in memory changes.
    Strided depthwise convolutions become `StridedDepthwise`. Results differ by rounding.

    Args:
        model: changed in place.

    Returns:
        The network itself.

    >>> conv = nn.Conv3d(2, 2, 3)
    >>> prepare_for_training(nn.Sequential(conv))[0] is conv
    True
    >>> conv.weight.is_contiguous(memory_format=torch.channels_last_3d)
    True
    """
    for module in model.modules():
        if isinstance(module, nn.Conv3d | nn.ConvTranspose3d):
            module.to(memory_format=torch.channels_last_3d)
        elif isinstance(module, nn.Conv2d):
            depthwise = module.groups == module.in_channels > 1
            if depthwise or module.kernel_size == (1, 1):
                module.to(memory_format=torch.channels_last)
            if depthwise and module.stride != (1, 1) and type(module) is nn.Conv2d:
                module.__class__ = StridedDepthwise
    return model
