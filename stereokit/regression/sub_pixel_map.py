"""Disparity from the neighbourhood of the most probable candidate: the estimator of PDS-Net."""

import torch
from torch import Tensor, nn

from stereokit.errors import ConfigError, InputError
from stereokit.layers import at_least_float32
from stereokit.registry import REGRESSIONS

__all__ = ["SubPixelMap", "sub_pixel_map"]


def sub_pixel_map(logits: Tensor, candidates: Tensor | None = None, *, radius: int = 2) -> Tensor:
    r"""Expected candidate under the softmax of the levels around the largest logit alone.

    .. math::
        \hat d = \sum_{|d - m| \le r} x_d\, \mathrm{softmax}_{|d - m| \le r}(c)_d, \quad m = \arg\max_d c_d

    Of several peaks it takes the highest, where a soft-argmin would lie between them.

    Args:
        logits: c, (B, D, H, W).
        candidates: x, (D,) or broadcastable to the logits; 0, 1, ..., D - 1 by default.
        radius: r, in levels. Levels that there are not do not count.

    Returns:
        (B, H, W), in the unit of the candidates; float32 or, for float64 logits, float64.

    Raises:
        InputError: the logits do not have four dimensions.

    Source: Tulyakov et al., "Practical Deep Stereo (PDS): toward applications-friendly deep stereo matching",
    NeurIPS 2018, equation 3.

    >>> two_peaks = torch.tensor([9.0, 0.0, 0.0, 0.0, 5.0, 9.5, 5.0]).reshape(1, 7, 1, 1)
    >>> round(sub_pixel_map(two_peaks, radius=1).item(), 4)
    5.0
    """
    kept, level = _around_the_peak(logits, radius)
    if candidates is None:
        values = level
    else:
        volume = candidates.reshape(-1, 1, 1) if candidates.dim() == 1 else candidates
        values = volume.expand_as(logits).gather(1, level)
    return (kept.softmax(1) * values).sum(1)


def _around_the_peak(logits: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Logits and levels within the radius, (B, 2r + 1, H, W) each; -inf for those that there are not."""
    if logits.dim() != 4:
        raise InputError(f"logits are (B, D, H, W); got {tuple(logits.shape)}")
    levels = logits.shape[1]
    offsets = torch.arange(-radius, radius + 1, device=logits.device).reshape(-1, 1, 1)
    wanted = logits.argmax(1, keepdim=True) + offsets
    level = wanted.clamp(0, levels - 1)
    kept = at_least_float32(logits.gather(1, level))
    return kept.masked_fill(wanted != level, -torch.inf), level


@REGRESSIONS.register("sub_pixel_map")
class SubPixelMap(nn.Module):
    """`sub_pixel_map` as a module.

    Args:
        radius: in levels.

    Raises:
        ConfigError: a radius that is not a whole number from 0 up.

    Source: Tulyakov et al., NeurIPS 2018, equation 3.

    >>> SubPixelMap()(torch.rand(2, 48, 8, 16)).shape
    torch.Size([2, 8, 16])
    """

    min_levels = 1

    def __init__(self, *, radius: int = 2) -> None:
        super().__init__()
        if isinstance(radius, bool) or not isinstance(radius, int) or radius < 0:
            raise ConfigError(f"radius={radius!r} is not a whole number of levels from 0 up")
        self.radius = radius

    def forward(self, logits: Tensor, candidates: Tensor | None = None) -> Tensor:
        """(B, D, H, W) to (B, H, W)."""
        return sub_pixel_map(logits, candidates, radius=self.radius)

    def with_confidence(self, logits: Tensor, candidates: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Estimate, and the share of the probability that the levels around the peak hold, both (B, H, W)."""
        kept, _ = _around_the_peak(logits, self.radius)
        mass = (kept.logsumexp(1) - at_least_float32(logits).logsumexp(1)).exp().clamp(max=1)
        return self(logits, candidates), mass

    def extra_repr(self) -> str:
        """The radius, for printing."""
        return f"radius={self.radius}"
