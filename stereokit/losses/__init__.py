"""Training losses over the known pixels, by name: see `LOSSES`."""

from stereokit.losses.cross_entropy import CrossEntropy, masked_cross_entropy, truth_of_cells
from stereokit.losses.density import Density, density_divergence
from stereokit.losses.l1 import L1, mean_of_cells
from stereokit.losses.laplace import LaplaceCrossEntropy, laplace_cross_entropy
from stereokit.losses.quantile import Quantile, masked_pinball
from stereokit.losses.robust import Robust
from stereokit.losses.sequence import Sequence
from stereokit.losses.smooth_l1 import SmoothL1, masked_smooth_l1
from stereokit.losses.stereo_focal import StereoFocal, confidence_loss, stereo_focal_loss, unimodal_target
from stereokit.losses.total import Loss, named_loss, stereo_loss
from stereokit.losses.wasserstein import Wasserstein, masked_wasserstein, neighborhood_truth, wasserstein_distance

__all__ = [
    "L1",
    "CrossEntropy",
    "Density",
    "LaplaceCrossEntropy",
    "Loss",
    "Quantile",
    "Robust",
    "Sequence",
    "SmoothL1",
    "StereoFocal",
    "Wasserstein",
    "confidence_loss",
    "density_divergence",
    "laplace_cross_entropy",
    "masked_cross_entropy",
    "masked_pinball",
    "masked_smooth_l1",
    "masked_wasserstein",
    "mean_of_cells",
    "named_loss",
    "neighborhood_truth",
    "stereo_focal_loss",
    "stereo_loss",
    "truth_of_cells",
    "unimodal_target",
    "wasserstein_distance",
]
