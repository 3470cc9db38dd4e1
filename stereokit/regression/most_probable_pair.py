"""Disparity from the two neighbouring candidates that are the most probable together: the estimator of HD3."""

import torch
from torch import Tensor, nn

from stereokit.errors import InputError
from stereokit.registry import REGRESSIONS
from stereokit.regression.soft_argmin import softmax

__all__ = ["MostProbablePair", "most_probable_pair"]


def most_probable_pair(logits: Tensor, candidates: Tensor | None = None) -> Tensor:
    r"""Expected candidate under the softmax of the two neighbouring levels with the largest sum of probabilities.

    .. math:: \hat d = \frac{p_k\, x_k + p_{k+1}\, x_{k+1}}{p_k + p_{k+1}}, \quad
        k = \arg\max_d\, (p_d + p_{d+1}), \quad p = \mathrm{softmax}(c)

    As CoEx's top-k with k = 2, but that the two lie side by side: of two peaks it takes one.

    Args:
        logits: c, (B, D, H, W), of at least two levels.
        candidates: x, (D,) or broadcastable to the logits; 0, 1, ..., D - 1 by default.

    Returns:
        (B, H, W), in the unit of the candidates; float32 or, for float64 logits, float64.

    Raises:
        InputError: the logits do not have four dimensions, or there is one level.

    Source: Yin et al., "Hierarchical discrete distribution decomposition for match density estimation", CVPR 2019,
    section 3.4.

    >>> two_peaks = torch.tensor([9.0, 0.0, 0.0, 8.9, 8.9]).reshape(1, 5, 1, 1)
    >>> most_probable_pair(two_peaks).item()
    3.5
    """
    return _estimate_and_mass(logits, candidates)[0]


def _estimate_and_mass(logits: Tensor, candidates: Tensor | None) -> tuple[Tensor, Tensor]:
    """The estimate, and the probability of the pair, (B, H, W) each."""
    if logits.dim() != 4 or logits.shape[1] < 2:
        raise InputError(f"logits are (B, D, H, W), D at least 2; got {tuple(logits.shape)}")
    probability = softmax(logits)
    mass, first = (probability[:, :-1] + probability[:, 1:]).max(1, keepdim=True)
    level = torch.cat((first, first + 1), dim=1)
    if candidates is None:
        values = level
    else:
        volume = candidates.reshape(-1, 1, 1) if candidates.dim() == 1 else candidates
        values = volume.expand_as(logits).gather(1, level)
    return (softmax(logits.gather(1, level)) * values).sum(1), mass.squeeze(1).clamp(max=1)


@REGRESSIONS.register("most_probable_pair")
class MostProbablePair(nn.Module):
    """`most_probable_pair` as a module.

    Source: Yin et al., CVPR 2019, section 3.4.

    >>> MostProbablePair()(torch.rand(2, 48, 8, 16)).shape
    torch.Size([2, 8, 16])
    """

    min_levels = 2

    def forward(self, logits: Tensor, candidates: Tensor | None = None) -> Tensor:
        """(B, D, H, W) to (B, H, W)."""
        return most_probable_pair(logits, candidates)

    def with_confidence(self, logits: Tensor, candidates: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Estimate, and the probability of the pair, both (B, H, W)."""
        return _estimate_and_mass(logits, candidates)
