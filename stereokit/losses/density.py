"""Divergence between match densities and the truth."""

import torch
from torch import Tensor

from stereokit.contracts import Distribution, Prediction
from stereokit.losses.cross_entropy import distribution_of, known_cells, two_level_entropy
from stereokit.losses.known import mean_over_known
from stereokit.registry import LOSSES

__all__ = ["Density", "density_divergence"]


def density_divergence(distribution: Distribution, truth: Tensor, *, max_disparity: float | None = None) -> Tensor:
    r"""Mean Kullback-Leibler divergence of the distribution over the levels from the truth, split between two levels.

    .. math::
        L = \frac{1}{N} \sum_i q_{i,l} \log \frac{q_{i,l}}{p_i(l)} + q_{i,l+1} \log \frac{q_{i,l+1}}{p_i(l + 1)}, \quad
        q_{i,l} = 1 - w_i, \quad q_{i,l+1} = w_i

    with l and w as in `masked_cross_entropy`, whose gradient it has, but that each cell goes by the mean of the known
    truth within it, and that it is 0 where it is least. A truth beyond the levels belongs to the nearest.

    Args:
        distribution: its logits, (B, L, h, w), give p; its planes are x. Offsets do not count.
        truth: g, (B, H, W), pixels; 0, negative and non-finite values are unknown. The logits may reach beyond, where
            the images were padded.
        max_disparity: as in `masked_smooth_l1`.

    Returns:
        A scalar; 0, with a gradient of 0, where no cell is known.

    Raises:
        InputError: the logits do not cover the ground truth.

    Source: Yin et al., "Hierarchical discrete distribution decomposition for match density estimation", CVPR 2019,
    section 3.5.

    >>> logits = torch.tensor([0.0, 0.0, -torch.inf]).reshape(1, 3, 1, 1)
    >>> halves = Distribution(logits, stride=2, spacing=4)
    >>> density_divergence(halves, torch.tensor([[[1.0, 3.0], [torch.nan, 2.0]]])).item()
    0.0
    """
    cells, known, logits = known_cells(distribution, truth, max_disparity, mean=True)
    entropy, share = two_level_entropy(distribution, cells, known, logits)
    own = torch.special.entr(share) + torch.special.entr(1 - share)
    return mean_over_known(entropy - own, known)


@LOSSES.register("density")
class Density:
    """`density_divergence` of a prediction's distribution.

    >>> logits = torch.zeros(1, 2, 1, 1)
    >>> prediction = Prediction(torch.ones(1, 1, 1), 4, Distribution(logits, stride=4, spacing=4))
    >>> round(Density()(prediction, torch.full((1, 4, 4), 2.0), max_disparity=None).item(), 4)
    0.0
    """

    def __call__(self, prediction: Prediction, truth: Tensor, *, max_disparity: float | None) -> Tensor:
        """The mean over the known cells.

        Raises:
            ConfigError: the prediction comes from no distribution.
        """
        return density_divergence(distribution_of(prediction, "density"), truth, max_disparity=max_disparity)
