"""The loss of networks that begin with a regression and mend what it gives."""

from torch import Tensor

from stereokit.contracts import Prediction
from stereokit.losses.l1 import L1
from stereokit.losses.smooth_l1 import SmoothL1
from stereokit.registry import LOSSES

__all__ = ["Sequence"]


@LOSSES.register("sequence")
class Sequence:
    """Smooth L1 of a prediction that comes from a distribution over disparities, L1 of one that does not.

    Source: Xu et al., "Iterative geometry encoding volume for stereo matching", CVPR 2023, section 3.5.

    >>> import torch
    >>> Sequence()(Prediction(torch.zeros(1, 1, 1)), torch.full((1, 1, 1), 0.5), max_disparity=None).item()
    0.5
    """

    def __init__(self) -> None:
        self.first = SmoothL1()
        self.others = L1()

    def __call__(self, prediction: Prediction, truth: Tensor, *, max_disparity: float | None) -> Tensor:
        """The mean over the known pixels; 0, with a gradient of 0, where there is none."""
        measure = self.others if prediction.distribution is None else self.first
        return measure(prediction, truth, max_disparity=max_disparity)
