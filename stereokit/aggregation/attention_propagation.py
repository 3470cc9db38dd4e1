"""Propagation of a disparity distribution from neighbours that are sure of themselves."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.layers import at_least_float32, warp

__all__ = ["AttentionPropagation", "propagate_attention"]

NEIGHBORS = ((-1, -1), (0, 0), (1, 1), (1, -1), (-1, 1))
"""A cross that stands on its corner: y and x from the pixel."""


def propagate_attention(logits: Tensor, left: Tensor, right: Tensor, *, bias: Tensor, slope: Tensor) -> Tensor:
    r"""Logits of each pixel from its own and those of its four diagonal neighbours.

    .. math::
        \tilde a_i = \sum_{j \in N(i)} w_j a_j, \quad w = \mathrm{softmax}_{j}(u_j\, s_j), \quad
        u_j = \sigma(\beta + \gamma v_j), \quad s_j = \frac{1}{C} \sum_c l_c(i)\, r_c(i - m_j)

    with the mean :math:`m_j` and the variance :math:`v_j` of a neighbour's distribution: one counts that is sure, and
    whose disparity makes the pixel look like its partner. Beyond the border, the pixels there are repeated.

    Args:
        logits: a, (B, D, h, w), over the disparities 0, ..., D - 1 in pixels of the maps.
        left: l, (B, C, h, w).
        right: r, of the same shape; between two pixels interpolated linearly, outside 0.
        bias: beta, one number.
        slope: gamma, one number.

    Returns:
        (B, D, h, w).

    Source: Xu et al., "Accurate and efficient stereo matching via attention concatenation volume", TPAMI 2023, "Volume
    attention propagation".

    >>> logits = torch.randn(1, 8, 3, 4)
    >>> maps = torch.zeros(2, 1, 6, 3, 4)
    >>> mean_of_five = propagate_attention(logits, *maps, bias=torch.zeros(1), slope=torch.zeros(1))
    >>> bool((mean_of_five[0, :, 1, 1] - logits[0, :, [0, 1, 2, 2, 0], [0, 1, 2, 0, 2]].mean(1)).abs().max() < 1e-6)
    True
    """
    probability = at_least_float32(logits).softmax(1)
    levels = torch.arange(logits.shape[1], device=logits.device, dtype=probability.dtype).reshape(-1, 1, 1)
    mean = (probability * levels).sum(1, keepdim=True)
    variance = (probability * (levels - mean) ** 2).sum(1, keepdim=True)
    sure = (bias + slope * variance).sigmoid()
    similar = (left.unsqueeze(2) * warp(right, _neighbors(mean).squeeze(1))).mean(1)
    weights = (similar * _neighbors(sure).squeeze(1)).softmax(1)
    return (_neighbors(logits) * weights.unsqueeze(1)).sum(2)


def _neighbors(x: Tensor) -> Tensor:
    """(B, C, h, w) to (B, C, 5, h, w), the border repeated."""
    height, width = x.shape[-2:]
    padded = F.pad(x, (1, 1, 1, 1), mode="replicate")
    return torch.stack([padded[..., 1 + y : 1 + y + height, 1 + x : 1 + x + width] for y, x in NEIGHBORS], dim=2)


class AttentionPropagation(nn.Module):
    """`propagate_attention` with learned beta, 2 in the beginning, and gamma, 0.

    Shape: logits (B, D, h, w) and maps (B, C, h, w) of both views to (B, D, h, w).

    >>> AttentionPropagation()(torch.rand(1, 8, 3, 4), *torch.rand(2, 1, 6, 3, 4)).shape
    torch.Size([1, 8, 3, 4])
    """

    def __init__(self) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.full((1,), 2.0))
        self.slope = nn.Parameter(torch.zeros(1))

    def forward(self, logits: Tensor, left: Tensor, right: Tensor) -> Tensor:
        """Logits, and features of both views, to logits."""
        return propagate_attention(logits, left, right, bias=self.bias, slope=self.slope)
