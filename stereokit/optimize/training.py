"""Memory formats for training."""

from typing import TypeVar

import torch
from torch import nn

__all__ = ["prepare_for_training"]

Network = TypeVar("Network", bound=nn.Module)


def prepare_for_training(model: Network) -> Network:
    """Puts the weights of 3D, of depthwise and of 1 x 1 convolutions into channels-last memory formats.

    Their values, names and gradients stay, and so do optimisers and checkpoints: only the order in memory changes.
    Results differ by rounding.

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
        elif isinstance(module, nn.Conv2d) and (
            module.groups == module.in_channels > 1 or module.kernel_size == (1, 1)
        ):
            module.to(memory_format=torch.channels_last)
    return model
