"""Means over the pixels whose truth is known."""

import torch
from torch import Tensor

__all__ = ["difference_where_known", "mean_over_known"]


def difference_where_known(truth: Tensor, disparity: Tensor, known: Tensor) -> Tensor:
    """Truth less disparity where the truth is known; elsewhere 0, with a gradient of 0 whatever either is there.

    What is computed from both and masked later has a gradient of 0 times infinity where the disparity is infinite.

    >>> disparity = torch.tensor([1.0, torch.inf], requires_grad=True)
    >>> difference_where_known(torch.tensor([3.0, torch.nan]), disparity, torch.tensor([True, False])).sum().backward()
    >>> disparity.grad.tolist()
    [-1.0, 0.0]
    """
    return torch.where(known, truth.to(disparity.dtype), 0) - torch.where(known, disparity, 0)


def mean_over_known(values: Tensor, known: Tensor) -> Tensor:
    """Mean of the values where `known`; 0, with a gradient of 0, where nothing is.

    >>> mean_over_known(torch.tensor([1.0, 3.0, torch.inf]), torch.tensor([True, True, False])).item()
    2.0
    """
    return torch.where(known, values, 0).sum() / known.sum().clamp(min=1)
