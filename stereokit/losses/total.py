"""The loss of all outputs of a network."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from torch import Tensor

from stereokit.contracts import Prediction, StereoOutput
from stereokit.errors import InputError
from stereokit.registry import LOSSES

__all__ = ["Loss", "named_loss", "stereo_loss"]


class Loss(Protocol):
    """How far one prediction is from the truth."""

    def __call__(self, prediction: Prediction, truth: Tensor, *, max_disparity: float | None) -> Tensor:
        """A scalar over the known pixels of truth (B, H, W); 0, with a gradient of 0, where there is none."""


def named_loss(loss: str | Mapping[str, Any]) -> Loss:
    """The loss of a name, see `list_components("losses")`.

    Args:
        loss: a name, or ``{"name": ..., **arguments}``.

    Raises:
        ConfigError: an unknown name or argument.

    >>> type(named_loss({"name": "robust", "scale": 1.0})).__name__
    'Robust'
    """
    made: Loss = LOSSES.build(*LOSSES.named(loss, "a loss is a name"))
    return made


def stereo_loss(
    output: StereoOutput,
    truth: Tensor,
    *,
    auxiliary_weights: Sequence[float],
    loss: str | Loss = "smooth_l1",
    max_disparity: float | None = None,
) -> Tensor:
    """Weighted mean of a loss over the predictions of a network, the last one with weight 1.

    Args:
        output: of a network in training mode.
        truth: (B, H, W), pixels; 0, negative and non-finite values are unknown.
        auxiliary_weights: one per prediction but the last; `StereoNetwork.auxiliary_weights` are those of the papers.
        loss: its registered name, or a function of a prediction and the truth.
        max_disparity: ground truth from there up does not count. None counts every known pixel.

    Raises:
        InputError: there are not as many weights as auxiliary predictions.

    >>> import torch
    >>> predictions = (Prediction(torch.zeros(1, 2, 2)), Prediction(torch.ones(1, 2, 2)))
    >>> output = StereoOutput(torch.ones(1, 2, 2), predictions)
    >>> stereo_loss(output, torch.ones(1, 2, 2), auxiliary_weights=(1,)).item()
    0.25
    """
    *auxiliary, last = output.predictions or (Prediction(output.disparity),)
    if len(auxiliary_weights) != len(auxiliary):
        raise InputError(
            f"{len(auxiliary_weights)} auxiliary weights for {len(auxiliary)} auxiliary predictions; a network gives "
            "these in training mode only, with their weights in model.auxiliary_weights"
        )
    measure = named_loss(loss) if isinstance(loss, str) else loss
    total = measure(last, truth, max_disparity=max_disparity)
    for weight, prediction in zip(auxiliary_weights, auxiliary, strict=True):
        total = total + weight * measure(prediction, truth, max_disparity=max_disparity)
    return total / (1 + sum(auxiliary_weights))
