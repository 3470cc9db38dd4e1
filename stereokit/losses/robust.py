"""The two-parameter robust loss of StereoNet, at one of its members."""

from torch import Tensor

from stereokit.contracts import Prediction, at_full_size
from stereokit.errors import ConfigError
from stereokit.losses.known import difference_where_known, mean_over_known
from stereokit.metrics import valid_pixels
from stereokit.registry import LOSSES

__all__ = ["Robust"]


@LOSSES.register("robust")
class Robust:
    r"""Pseudo-Huber distance: quadratic near 0, linear far away.

    .. math:: L = \frac{1}{N} \sum_i \sqrt{((g_i - \hat d_i) / c)^2 + 1} - 1

    A coarse prediction is enlarged to the size of the ground truth.

    Args:
        scale: c, in pixels.

    Raises:
        ConfigError: a scale that is not above 0.

    Source: Barron, "A general and adaptive robust loss function", CVPR 2019, with alpha = 1; Khamis et al.,
    "StereoNet", ECCV 2018, section 3.5, with c = 2.

    >>> import torch
    >>> round(Robust()(Prediction(torch.zeros(1, 1, 1)), torch.full((1, 1, 1), 2.0), max_disparity=None).item(), 4)
    0.4142
    """

    def __init__(self, *, scale: float = 2.0) -> None:
        if not scale > 0:
            raise ConfigError(f"scale={scale!r} px has to be above 0")
        self.scale = scale

    def __call__(self, prediction: Prediction, truth: Tensor, *, max_disparity: float | None) -> Tensor:
        """The mean over the known pixels; 0, with a gradient of 0, where there is none."""
        disparity = at_full_size(prediction, truth.shape[-2:])
        known = valid_pixels(truth, max_disparity=max_disparity)
        apart = difference_where_known(truth, disparity, known)
        distance = ((apart / self.scale) ** 2 + 1).sqrt() - 1
        return mean_over_known(distance, known)
