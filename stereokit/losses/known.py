"""Means over the pixels whose truth is known."""

import torch
from torch import Tensor

__all__ = ["mean_over_known"]


def mean_over_known(values: Tensor, known: Tensor) -> Tensor:
    """Mean of the values where `known`; 0, with a gradient of 0, where nothing is.

    >>> mean_over_known(torch.tensor([1.0, 3.0, torch.inf]), torch.tensor([True, True, False])).item()
    2.0
    """
    return torch.where(known, values, 0).sum() / known.sum().clamp(min=1)
