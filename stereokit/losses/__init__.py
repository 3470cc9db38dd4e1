"""Training losses over the known pixels."""

from stereokit.losses.cross_entropy import masked_cross_entropy, truth_of_cells
from stereokit.losses.smooth_l1 import masked_smooth_l1
from stereokit.losses.total import stereo_loss

__all__ = [
    "masked_cross_entropy",
    "masked_smooth_l1",
    "stereo_loss",
    "truth_of_cells",
]
