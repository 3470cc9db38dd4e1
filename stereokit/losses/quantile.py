"""The pinball loss of predictions that stand for a quantile."""

import torch
from torch import Tensor

from stereokit.contracts import Prediction, at_full_size
from stereokit.errors import ConfigError, InputError
from stereokit.losses.known import difference_where_known, mean_over_known
from stereokit.losses.smooth_l1 import masked_smooth_l1
from stereokit.metrics import valid_pixels
from stereokit.registry import LOSSES

__all__ = ["Quantile", "masked_pinball"]


def masked_pinball(disparity: Tensor, truth: Tensor, quantile: float, *, max_disparity: float | None = None) -> Tensor:
    r"""Mean pinball distance over the pixels with known ground truth.

    .. math:: L = \frac{1}{N} \sum_i \max(\tau (g_i - \hat d_i),\ (\tau - 1) (g_i - \hat d_i))

    It is least where a share tau of the truth lies below the estimate.

    Args:
        disparity: estimate, (B, H, W), pixels.
        truth: g, (B, H, W), pixels; 0, negative and non-finite values are unknown.
        quantile: tau, between 0 and 1.
        max_disparity: ground truth from there up does not count. None counts every known pixel.

    Returns:
        A scalar; 0, with a gradient of 0, where no pixel is known.

    Raises:
        InputError: the shapes differ, or another quantile.

    Source: Koenker and Bassett, "Regression quantiles", 1978; Duggal et al., "DeepPruner", ICCV 2019, section 3.4.

    >>> masked_pinball(torch.zeros(1, 1, 2), torch.tensor([[[2.0, torch.nan]]]), 0.25).item()
    0.5
    """
    if disparity.shape != truth.shape:
        raise InputError(
            f"estimate and ground truth differ in shape: {tuple(disparity.shape)} and {tuple(truth.shape)}"
        )
    if not 0 < quantile < 1:
        raise InputError(f"a quantile lies between 0 and 1; got {quantile}")
    known = valid_pixels(truth, max_disparity=max_disparity)
    apart = difference_where_known(truth, disparity, known)
    distance = torch.maximum(quantile * apart, (quantile - 1) * apart)
    return mean_over_known(distance, known)


@LOSSES.register("quantile")
class Quantile:
    """Smooth L1; for a prediction that stands for a quantile, that of the quantile and a share of smooth L1.

    Args:
        share: of smooth L1 beside the pinball loss.

    Raises:
        ConfigError: a negative share.

    Source: Duggal et al., "DeepPruner", ICCV 2019, section 3.4.

    >>> truth = torch.full((1, 1, 1), 2.0)
    >>> round(Quantile()(Prediction(torch.zeros(1, 1, 1), quantile=0.05), truth, max_disparity=None).item(), 4)
    1.15
    """

    def __init__(self, *, share: float = 0.7) -> None:
        if not share >= 0:
            raise ConfigError(f"share={share!r} of smooth L1 has to be 0 or more")
        self.share = share

    def __call__(self, prediction: Prediction, truth: Tensor, *, max_disparity: float | None) -> Tensor:
        """The mean over the known pixels; 0, with a gradient of 0, where there is none."""
        disparity = at_full_size(prediction, truth.shape[-2:])
        smooth = masked_smooth_l1(disparity, truth, max_disparity=max_disparity)
        if prediction.quantile is None:
            return smooth
        return masked_pinball(disparity, truth, prediction.quantile, max_disparity=max_disparity) + self.share * smooth
