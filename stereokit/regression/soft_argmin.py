"""Disparity from a distribution over candidates: soft-argmin and its top-k form."""

import torch
from torch import Tensor, nn

from stereokit.errors import ConfigError, InputError
from stereokit.layers import at_least_float32
from stereokit.registry import REGRESSIONS

__all__ = ["SoftArgmin", "TopKSoftArgmin", "soft_argmin", "top_k_mass", "top_k_soft_argmin"]


def soft_argmin(logits: Tensor, candidates: Tensor | None = None) -> Tensor:
    r"""Expected candidate under the softmax of the logits.

    .. math:: \hat d = \sum_d x_d\, \mathrm{softmax}(c)_d

    The name is that of GC-Net, whose costs are lower for better matches; logits here are larger for better ones.

    Args:
        logits: c, (B, D, H, W).
        candidates: x, (D,) or broadcastable to the logits; 0, 1, ..., D - 1 by default.

    Returns:
        (B, H, W), in the unit of the candidates; float32 or, for float64 logits, float64.

    Raises:
        InputError: the logits do not have four dimensions.

    Source: Kendall et al., "End-to-end learning of geometry and context for deep stereo regression", ICCV 2017,
    section 3.4.

    >>> round(soft_argmin(torch.tensor([0.0, 9.0, 9.0, 0.0]).reshape(1, 4, 1, 1)).item(), 4)
    1.5
    """
    _check_logits(logits)
    return expectation(softmax(logits), candidates)


def top_k_soft_argmin(logits: Tensor, k: int, candidates: Tensor | None = None) -> Tensor:
    r"""Expected candidate under the softmax of the k largest logits alone.

    .. math:: \hat d = \sum_{d \in K} x_d\, \mathrm{softmax}_{d \in K}(c)_d, \quad K = \text{the } k \text{ largest}

    With k = D it is `soft_argmin`, with k = 1 the argmax, whose gradient is 0.

    Args:
        logits: c, (B, D, H, W).
        k: from 1 to D.
        candidates: x, (D,) or broadcastable to the logits; 0, 1, ..., D - 1 by default.

    Returns:
        (B, H, W), in the unit of the candidates; float32 or, for float64 logits, float64.

    Raises:
        InputError: k is out of range, or the logits do not have four dimensions.

    Source: CoEx, section "Top-k disparity regression".

    >>> top_k_soft_argmin(torch.tensor([8.0, 1.0, 9.0, 9.0]).reshape(1, 4, 1, 1), k=2).item()
    2.5
    """
    _check_logits(logits)
    _check_k(k, logits.shape[1])
    if k == logits.shape[1]:
        return soft_argmin(logits, candidates)
    kept, index = logits.topk(k, dim=1)
    return _kept_expectation(logits, kept, index, candidates)


def top_k_mass(logits: Tensor, k: int) -> Tensor:
    """Share of the softmax over all candidates that the k largest hold.

    Args:
        logits: (B, D, H, W).
        k: from 1 to D.

    Returns:
        (B, H, W), from k / D (nothing stands out) to 1 (all on the kept ones).

    Raises:
        InputError: k is out of range, or the logits do not have four dimensions.

    >>> top_k_mass(torch.zeros(1, 8, 1, 1), k=2).item()
    0.25
    """
    _check_logits(logits)
    _check_k(k, logits.shape[1])
    return _kept_mass(logits, logits.topk(k, dim=1).values)


@REGRESSIONS.register("soft_argmin")
class SoftArgmin(nn.Module):
    """`soft_argmin` as a module.

    Args:
        include_end: stretch the candidates, where they are uniform, so that the last one is the end of the range: their
            step becomes D / (D - 1), as in published weights of StereoNet.

    Source: Kendall et al., ICCV 2017, section 3.4.

    >>> SoftArgmin()(torch.rand(2, 48, 8, 16)).shape
    torch.Size([2, 8, 16])
    """

    min_levels = 1

    def __init__(self, *, include_end: bool = False) -> None:
        super().__init__()
        self.include_end = include_end
        self.min_levels = 2 if include_end else 1

    def forward(self, logits: Tensor, candidates: Tensor | None = None) -> Tensor:
        """(B, D, H, W) to (B, H, W)."""
        return self._stretched(soft_argmin(logits, candidates), logits, candidates)

    def with_confidence(self, logits: Tensor, candidates: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Estimate and probability mass of the four candidates nearest to it, both (B, H, W).

        All of the mass is kept by a soft-argmin, so what lies near the estimate is counted in its place: low where the
        distribution has several peaks or is flat. Source: Yao et al., "MVSNet", ECCV 2018, section 4.2.
        """
        _check_logits(logits)
        probability = softmax(logits)
        estimate = expectation(probability, candidates)
        return self._stretched(estimate, logits, candidates), mass_near(probability, estimate, candidates)

    def _stretched(self, estimate: Tensor, logits: Tensor, candidates: Tensor | None) -> Tensor:
        levels = logits.shape[1]
        return estimate * (levels / (levels - 1)) if self.include_end and candidates is None else estimate


@REGRESSIONS.register("top_k")
class TopKSoftArgmin(nn.Module):
    """`top_k_soft_argmin` as a module.

    Args:
        k: candidates kept, from 1 to the number of levels.
        test_k: candidates kept in eval mode; None for k.

    Raises:
        ConfigError: k or test_k is not a positive whole number.

    Source: CoEx, section "Top-k disparity regression".

    >>> TopKSoftArgmin(k=2)(torch.rand(2, 48, 8, 16)).shape
    torch.Size([2, 8, 16])
    """

    def __init__(self, k: int = 2, *, test_k: int | None = None) -> None:
        super().__init__()
        for name, value in (("k", k), ("test_k", test_k)):
            if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
                raise ConfigError(f"{name}={value!r} is not a whole number from 1 to the number of levels")
        self.k = k
        self.test_k = k if test_k is None else test_k
        self.min_levels = max(self.k, self.test_k)

    def forward(self, logits: Tensor, candidates: Tensor | None = None) -> Tensor:
        """(B, D, H, W) to (B, H, W)."""
        return top_k_soft_argmin(logits, self.k if self.training else self.test_k, candidates)

    def with_confidence(self, logits: Tensor, candidates: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Estimate and `top_k_mass`, both (B, H, W), from one search for the k largest."""
        _check_logits(logits)
        k = self.k if self.training else self.test_k
        _check_k(k, logits.shape[1])
        kept, index = logits.topk(k, dim=1)
        return _kept_expectation(logits, kept, index, candidates), _kept_mass(logits, kept)

    def extra_repr(self) -> str:
        """The numbers of candidates, for printing."""
        return f"k={self.k}, test_k={self.test_k}"


def softmax(logits: Tensor) -> Tensor:
    """Over the levels, in single precision or better."""
    return at_least_float32(logits).softmax(1)


def expectation(probability: Tensor, candidates: Tensor | None = None) -> Tensor:
    """Mean of the candidates, weighed by (B, D, H, W) probabilities."""
    if candidates is None:
        candidates = torch.arange(probability.shape[1], device=probability.device)
    # not as a matrix product, which autocast and TF32 would round to steps of half a pixel
    return (probability * _as_volume(candidates)).sum(1)


def mass_near(probability: Tensor, estimate: Tensor, candidates: Tensor | None = None) -> Tensor:
    """Probability (B, D, H, W) of the four candidates nearest to an estimate (B, H, W)."""
    levels = probability.shape[1]
    # of the last candidate at or below the estimate
    level = estimate if candidates is None else (_as_volume(candidates) <= estimate.unsqueeze(1)).sum(1) - 1
    nearest = level.long().unsqueeze(1) + torch.arange(-1, 3, device=level.device).reshape(-1, 1, 1)
    mass = probability.gather(1, nearest.clamp(0, levels - 1))
    return (mass * ((nearest >= 0) & (nearest < levels))).sum(1).clamp(max=1)


def _kept_expectation(logits: Tensor, kept: Tensor, index: Tensor, candidates: Tensor | None = None) -> Tensor:
    values = index if candidates is None else _as_volume(candidates).expand_as(logits).gather(1, index)
    return (softmax(kept) * values).sum(1)


def _kept_mass(logits: Tensor, kept: Tensor) -> Tensor:
    kept, logits = at_least_float32(kept), at_least_float32(logits)
    return (kept.logsumexp(1) - logits.logsumexp(1)).exp().clamp(max=1)


def _as_volume(candidates: Tensor) -> Tensor:
    return candidates.reshape(-1, 1, 1) if candidates.dim() == 1 else candidates


def _check_logits(logits: Tensor) -> None:
    if logits.dim() != 4:
        raise InputError(f"logits are (B, D, H, W); got {tuple(logits.shape)}")


def _check_k(k: int, levels: int) -> None:
    if not 1 <= k <= levels:
        raise InputError(f"k={k} is outside 1..{levels}, the number of disparity levels")
