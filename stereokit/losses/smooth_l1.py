"""Smooth L1 of disparities."""

import torch
from torch import Tensor
from torch.nn import functional as F

from stereokit.contracts import Prediction, at_full_size
from stereokit.errors import InputError
from stereokit.losses.known import difference_where_known, mean_over_known
from stereokit.metrics import valid_pixels
from stereokit.registry import LOSSES

__all__ = ["SmoothL1", "masked_smooth_l1"]


def masked_smooth_l1(disparity: Tensor, truth: Tensor, *, max_disparity: float | None = None) -> Tensor:
    r"""Mean smooth-L1 distance over the pixels with known ground truth.

    .. math:: L = \frac{1}{N} \sum_{i:\, 0 < g_i < D} \mathrm{smooth}_{L_1}(g_i - \hat d_i)

    Args:
        disparity: estimate, (B, H, W), pixels.
        truth: g, (B, H, W), pixels; 0, negative and non-finite values are unknown.
        max_disparity: D; ground truth from there up does not count. None counts every known pixel.

    Returns:
        A scalar; 0, with a gradient of 0, where no pixel is known.

    Raises:
        InputError: the shapes differ, or a ceiling that leaves nothing.

    Source: CoEx, equation "smooth L1".

    >>> masked_smooth_l1(torch.tensor([[[1.0, 9.0]]]), torch.tensor([[[3.0, torch.nan]]])).item()
    1.5
    """
    if disparity.shape != truth.shape:
        raise InputError(
            f"estimate and ground truth differ in shape: {tuple(disparity.shape)} and {tuple(truth.shape)}"
        )
    known = valid_pixels(truth, max_disparity=max_disparity)
    apart = difference_where_known(truth, disparity, known)
    distance = F.smooth_l1_loss(apart, torch.zeros_like(apart), reduction="none")
    return mean_over_known(distance, known)


@LOSSES.register("smooth_l1")
class SmoothL1:
    """`masked_smooth_l1` of a prediction, enlarged to the size of the truth where it is coarse.

    >>> SmoothL1()(Prediction(torch.ones(1, 2, 2)), torch.ones(1, 2, 2), max_disparity=None).item()
    0.0
    """

    def __call__(self, prediction: Prediction, truth: Tensor, *, max_disparity: float | None) -> Tensor:
        """The mean over the known pixels."""
        disparity = at_full_size(prediction, truth.shape[-2:])
        return masked_smooth_l1(disparity, truth, max_disparity=max_disparity)
