"""L1 at the resolution of the prediction."""

import torch
from torch import Tensor
from torch.nn import functional as F

from stereokit.contracts import Prediction
from stereokit.losses.known import difference_where_known, mean_over_known
from stereokit.metrics import valid_pixels
from stereokit.registry import LOSSES

__all__ = ["L1", "mean_of_cells"]


def mean_of_cells(truth: Tensor, stride: int, *, max_disparity: float | None = None) -> tuple[Tensor, Tensor]:
    """The mean of the known ground truth in each cell of `stride` x `stride` pixels, and whether there is any.

    Args:
        truth: (B, H, W), pixels; 0, negative and non-finite values are unknown.
        stride: of the cells; the last ones may be cut by the border.
        max_disparity: ground truth from there up does not count.

    Returns:
        Two (B, h, w), with h and w rounded up: values in pixels, 0 where none is known; and bool.

    >>> mean_of_cells(torch.tensor([[[2.0, 4.0], [torch.nan, 0.0]]]), 2)
    (tensor([[[3.]]]), tensor([[[True]]]))
    """
    known = valid_pixels(truth, max_disparity=max_disparity)
    height, width = truth.shape[-2:]
    to_full_cells = (0, -width % stride, 0, -height % stride)
    values, counts = (
        F.avg_pool2d(F.pad(x.unsqueeze(1), to_full_cells), stride).squeeze(1)
        for x in (torch.where(known, truth, 0), known.to(truth.dtype))
    )
    return torch.where(counts > 0, values / counts.clamp(min=torch.finfo(counts.dtype).tiny), 0), counts > 0


@LOSSES.register("l1")
class L1:
    r"""Mean absolute difference from the ground truth, which is averaged down to the prediction's resolution.

    .. math:: L = \frac{1}{N} \sum_i |\bar g_i - \hat d_i|

    Values are in pixels of the full-size image at every resolution.

    Source: Mayer et al., "A large dataset to train convolutional networks for disparity, optical flow, and scene flow
    estimation", CVPR 2016, section 5.

    >>> L1()(Prediction(torch.ones(1, 1, 1), stride=2), torch.full((1, 2, 2), 4.0), max_disparity=None).item()
    3.0
    """

    def __call__(self, prediction: Prediction, truth: Tensor, *, max_disparity: float | None) -> Tensor:
        """The mean over the known cells; 0, with a gradient of 0, where there is none."""
        target, known = mean_of_cells(truth, prediction.stride, max_disparity=max_disparity)
        rows, columns = target.shape[-2:]
        # the prediction may cover the padding too
        disparity = prediction.disparity[:, :rows, :columns]
        distance = difference_where_known(target, disparity, known).abs()
        return mean_over_known(distance, known)
