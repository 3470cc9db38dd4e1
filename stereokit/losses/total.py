"""The loss of all outputs of a network."""

from collections.abc import Sequence

from torch import Tensor

from stereokit.errors import InputError
from stereokit.losses.smooth_l1 import masked_smooth_l1
from stereokit.model import StereoOutput

__all__ = ["stereo_loss"]


def stereo_loss(
    output: StereoOutput,
    truth: Tensor,
    *,
    auxiliary_weights: Sequence[float],
    max_disparity: float | None = None,
) -> Tensor:
    """Weighted mean of `masked_smooth_l1` over the outputs of a network, the final one with weight 1.

    Args:
        output: of a network in training mode.
        truth: (B, H, W), pixels; 0, negative and non-finite values are unknown.
        auxiliary_weights: one per auxiliary disparity; `StereoModel.auxiliary_weights` are those of the papers.
        max_disparity: as in `masked_smooth_l1`.

    Raises:
        InputError: there are not as many weights as auxiliary disparities.

    >>> import torch
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
