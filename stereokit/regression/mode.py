"""Disparity as the most probable candidate."""

from torch import Tensor, nn

from stereokit.errors import InputError
from stereokit.layers import at_least_float32
from stereokit.registry import REGRESSIONS

__all__ = ["Mode", "mode"]


def mode(logits: Tensor, candidates: Tensor | None = None) -> Tensor:
    r"""The candidate with the largest logit; of several that are equal, one of them.

    .. math:: \hat d = x_m, \quad m = \arg\max_d c_d

    It never lies between two peaks. It has a gradient to the candidates, where these are learned, and none to the
    logits: train it with a loss of the distribution, such as "wasserstein".

    Args:
        logits: c, (B, D, H, W).
        candidates: x, (D,) or broadcastable to the logits; 0, 1, ..., D - 1 by default.

    Returns:
        (B, H, W), in the unit of the candidates; float32 or, for float64 logits, float64.

    Raises:
        InputError: the logits do not have four dimensions.

    Source: Garg et al., "Wasserstein distances for stereo disparity estimation", NeurIPS 2020.

    >>> import torch
    >>> mode(torch.tensor([8.0, 1.0, 9.0, 5.0]).reshape(1, 4, 1, 1)).item()
    2.0
    """
    if logits.dim() != 4:
        raise InputError(f"logits are (B, D, H, W); got {tuple(logits.shape)}")
    level = logits.argmax(1, keepdim=True)
    if candidates is None:
        return at_least_float32(level.to(logits.dtype)).squeeze(1)
    volume = candidates.reshape(-1, 1, 1) if candidates.dim() == 1 else candidates
    return at_least_float32(volume.expand_as(logits).gather(1, level)).squeeze(1)


@REGRESSIONS.register("mode")
class Mode(nn.Module):
    """`mode` as a module.

    Source: Garg et al., NeurIPS 2020.

    >>> import torch
    >>> Mode()(torch.rand(2, 48, 8, 16)).shape
    torch.Size([2, 8, 16])
    """

    min_levels = 1
    test_k = 1
    """The candidates that it keeps."""

    def forward(self, logits: Tensor, candidates: Tensor | None = None) -> Tensor:
        """(B, D, H, W) to (B, H, W)."""
        return mode(logits, candidates)

    def with_confidence(self, logits: Tensor, candidates: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Estimate and its probability, both (B, H, W)."""
        precise = at_least_float32(logits)
        return mode(logits, candidates), (precise.amax(1) - precise.logsumexp(1)).exp().clamp(max=1)
