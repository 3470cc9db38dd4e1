"""The measures of one pair or batch: EPE, bad-tau, D1, and predictions that are not finite."""

import torch
from torch import Tensor

from stereokit.metrics.known import absolute_error, checked_tau, is_outlier

__all__ = ["KITTI_METRICS", "bad_pixels", "d1", "end_point_error", "invalid_predictions"]

KITTI_METRICS = {
    "D1-all": "d1",
    "D1-bg": "d1_bg",
    "D1-fg": "d1_fg",
    "Out-All": "bad_3_per_image",
    "Out-Noc": "bad_3_noc_per_image",
    "Avg-All": "epe_per_image",
    "Avg-Noc": "epe_noc_per_image",
}
"""The KITTI leaderboards' names for results of `StereoMetrics`: D1 is of KITTI 2015, Out and Avg of 2012."""


def end_point_error(
    prediction: Tensor,
    truth: Tensor,
    mask: Tensor | None = None,
    *,
    max_disparity: float | None = None,
    min_disparity: float = 0,
) -> float | None:
    """The mean end-point error (EPE) over all counted pixels that have a finite prediction, in pixels.

    EPE = mean |d - d*|. Report `invalid_predictions` beside it where there are any.

    Args:
        prediction: d, any shape, in pixels.
        truth: d*, of the prediction's shape; 0 or non-finite is unknown.
        mask: bool, of the same shape; pixels to leave out are False.
        max_disparity: ceiling of the truth, exclusive, in pixels.
        min_disparity: floor of the truth in pixels, see `valid_pixels`.

    Returns:
        The error in pixels, or None where there is no pixel to average.

    Raises:
        InputError: tensors of different shapes or of the wrong type.

    >>> end_point_error(torch.tensor([10.0, 21.0, 30.0]), torch.tensor([12.0, 20.0, 0.0]))
    1.5
    >>> end_point_error(torch.tensor([10.0]), torch.tensor([0.0])) is None
    True
    """
    error, _, valid = absolute_error(prediction, truth, mask, max_disparity, min_disparity)
    return _mean(error[valid & torch.isfinite(error)])


def bad_pixels(
    prediction: Tensor,
    truth: Tensor,
    tau: float,
    mask: Tensor | None = None,
    *,
    max_disparity: float | None = None,
    min_disparity: float = 0,
) -> float | None:
    """Bad-tau: the share of counted pixels whose error is larger than tau pixels, in percent.

    bad-tau = 100 |{|d - d*| > tau}| / |{counted}|

    KITTI 2012 calls it Out for tau = 3, Middlebury "bad 2.0" for tau = 2. A non-finite prediction is bad.

    Args:
        prediction: d, any shape, in pixels.
        truth: d*, of the prediction's shape; 0 or non-finite is unknown.
        tau: threshold in pixels; an error of exactly tau is not bad.
        mask: bool, of the same shape; pixels to leave out are False.
        max_disparity: ceiling of the truth, exclusive, in pixels.
        min_disparity: floor of the truth in pixels, see `valid_pixels`.

    Returns:
        0 to 100, or None where no pixel counts.

    Raises:
        InputError: tensors of different shapes or of the wrong type, or a tau that is negative or not finite.

    Source: KITTI 2012 stereo devkit, `disparityErrorsOutlier`; Middlebury stereo evaluation v3, "bad".

    >>> bad_pixels(torch.tensor([10.0, 25.0]), torch.tensor([13.0, 20.0]), tau=3)
    50.0
    """
    error, _, valid = absolute_error(prediction, truth, mask, max_disparity, min_disparity)
    return _percent((error > checked_tau(tau))[valid])


def d1(
    prediction: Tensor,
    truth: Tensor,
    mask: Tensor | None = None,
    *,
    max_disparity: float | None = None,
    min_disparity: float = 0,
) -> float | None:
    """D1: the share of counted pixels that are outliers in KITTI 2015's sense, in percent.

    D1 = 100 |{|d - d*| > 3 px and |d - d*| / d* > 5 %}| / |{counted}|

    A non-finite prediction is an outlier. D1-bg and D1-fg are this over the mask of the background (object
    map 0) and of the foreground (object map above 0).

    Args:
        prediction: d, any shape, in pixels.
        truth: d*, of the prediction's shape; 0 or non-finite is unknown.
        mask: bool, of the same shape; pixels to leave out are False.
        max_disparity: ceiling of the truth, exclusive, in pixels. KITTI has none.
        min_disparity: floor of the truth in pixels, see `valid_pixels`.

    Returns:
        0 to 100, or None where no pixel counts.

    Raises:
        InputError: tensors of different shapes or of the wrong type.

    Source: KITTI 2015 scene flow devkit, `disparityErrorsOutlier` (Menze and Geiger, CVPR 2015).

    >>> d1(torch.tensor([14.0, 104.0, 106.0]), torch.tensor([10.0, 100.0, 0.0]))
    50.0
    """
    error, truth, valid = absolute_error(prediction, truth, mask, max_disparity, min_disparity)
    return _percent(is_outlier(error, truth)[valid])


def invalid_predictions(
    prediction: Tensor,
    truth: Tensor,
    mask: Tensor | None = None,
    *,
    max_disparity: float | None = None,
    min_disparity: float = 0,
) -> int:
    """How many counted pixels have a prediction that is not finite.

    Args:
        prediction: d, any shape, in pixels.
        truth: d*, of the prediction's shape; 0 or non-finite is unknown.
        mask: bool, of the same shape; pixels to leave out are False.
        max_disparity: ceiling of the truth, exclusive, in pixels.
        min_disparity: floor of the truth in pixels, see `valid_pixels`.

    Raises:
        InputError: tensors of different shapes or of the wrong type.

    >>> from math import inf, nan
    >>> invalid_predictions(torch.tensor([nan, inf, nan]), torch.tensor([5.0, 5.0, 0.0]))
    2
    """
    error, _, _ = absolute_error(prediction, truth, mask, max_disparity, min_disparity)
    return int(torch.isinf(error).sum())


def _mean(values: Tensor) -> float | None:
    return float(values.mean()) if values.numel() else None


def _percent(flags: Tensor) -> float | None:
    return 100.0 * int(flags.sum()) / flags.numel() if flags.numel() else None
