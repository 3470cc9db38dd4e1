"""Networks whose norms have the statistics of what flows through them."""

from collections.abc import Sequence

import torch
from torch import nn

from stereokit import build_model


def with_statistics(model: nn.Module, images: Sequence[torch.Tensor]) -> nn.Module:
    """Gives every batch norm the statistics of one pass; returns the network in eval mode."""
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d | nn.BatchNorm3d):
            module.momentum = None  # plain average
    with torch.no_grad():
        model.train()(*images)
    return model.eval()


def settle(model: nn.Module) -> nn.Module:
    """Gives every batch norm statistics, a gain and a shift of its own; returns the network in eval mode."""
    norms = [m for m in model.modules() if isinstance(m, nn.BatchNorm2d | nn.BatchNorm3d)]
    for norm in norms:
        nn.init.uniform_(norm.weight, 0.5, 1.5)
        nn.init.normal_(norm.bias, std=0.1)
    return with_statistics(model, torch.rand(2, 2, 3, 64, 96))


def settled(name: str, **overrides: object) -> nn.Module:
    return settle(build_model(name, max_disparity=32, **overrides))


def off(prepared: nn.Module, plain: nn.Module, height: int, width: int) -> torch.Tensor:
    """How far two networks differ in each pixel, px."""
    left, right = torch.rand(2, 1, 3, height, width)
    with torch.inference_mode():
        return (prepared(left, right).disparity - plain(left, right).disparity).abs()
