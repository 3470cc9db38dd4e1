"""The training loss of CoEx, PSMNet and their kin: smooth L1 over the known pixels, averaged over the outputs."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from stereokit.errors import InputError
from stereokit.model import StereoOutput

__all__ = ["masked_smooth_l1", "stereo_loss"]


def masked_smooth_l1(disparity: Tensor, truth: Tensor, *, max_disparity: float = math.inf) -> Tensor:
    r"""Mean smooth-L1 distance over the pixels with known ground truth.

    .. math:: L = \frac{1}{N} \sum_{i:\, 0 < g_i < D} \mathrm{smooth}_{L_1}(g_i - \hat d_i)

    Args:
        disparity: estimate, (B, H, W), pixels.
        truth: g, (B, H, W), pixels; 0, negative and non-finite values are unknown.
        max_disparity: D; ground truth from there up does not count.

    Returns:
        A scalar; 0, with a gradient of 0, where no pixel is known.

    Raises:
        InputError: the shapes differ.

    Source: CoEx, equation "smooth L1".

    >>> masked_smooth_l1(torch.tensor([[[1.0, 9.0]]]), torch.tensor([[[3.0, torch.nan]]])).item()
    1.5
    """
    if disparity.shape != truth.shape:
        raise InputError(
            f"estimate and ground truth differ in shape: {tuple(disparity.shape)} and {tuple(truth.shape)}"
        )
    known = truth.isfinite() & (truth > 0) & (truth < max_disparity)
    target = torch.where(known, truth, disparity.detach())
    distance = F.smooth_l1_loss(disparity, target.to(disparity.dtype), reduction="none")
    return torch.where(known, distance, 0).sum() / known.sum().clamp(min=1)


def stereo_loss(
    output: StereoOutput,
    truth: Tensor,
    *,
    auxiliary_weights: Sequence[float],
    max_disparity: float = math.inf,
) -> Tensor:
    """Weighted mean of `masked_smooth_l1` over the outputs of a network, the final one with weight 1.

    Args:
        output: of a network in training mode.
        truth: (B, H, W), pixels; 0, negative and non-finite values are unknown.
        auxiliary_weights: one per auxiliary disparity; `StereoModel.auxiliary_weights` are those of the papers.
        max_disparity: ground truth from there up does not count.

    Raises:
        InputError: there are not as many weights as auxiliary disparities.

    >>> output = StereoOutput(torch.ones(1, 2, 2), auxiliary=(torch.zeros(1, 2, 2),))
    >>> stereo_loss(output, torch.ones(1, 2, 2), auxiliary_weights=(1,)).item()
    0.25
    """
    if len(auxiliary_weights) != len(output.auxiliary):
        raise InputError(
            f"{len(auxiliary_weights)} auxiliary weights for {len(output.auxiliary)} auxiliary disparities; a network "
            "gives them in training mode only, with their weights in model.auxiliary_weights"
        )
    total = masked_smooth_l1(output.disparity, truth, max_disparity=max_disparity)
    for weight, disparity in zip(auxiliary_weights, output.auxiliary, strict=True):
        total = total + weight * masked_smooth_l1(disparity, truth, max_disparity=max_disparity)
    return total / (1 + sum(auxiliary_weights))
