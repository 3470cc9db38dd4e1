"""The regression of GANet: logits and probabilities are filtered by weights that the image decides."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from stereokit.contracts import Guides
from stereokit.errors import ConfigError, InputError
from stereokit.layers import ConvNormAct, at_least_float32, init_convolutions, relu
from stereokit.registry import REGRESSIONS
from stereokit.regression.soft_argmin import expectation, mass_near, soft_argmin, softmax

__all__ = ["LocalGuidedSoftArgmin", "local_guided_aggregate"]

WINDOW = 5
PLANES = 3
REACH = WINDOW // 2
WEIGHTS = PLANES * WINDOW**2

BAND = 2**18
"""Voxels that a CPU filters at a time: they stay in its cache through all weights."""


def local_guided_aggregate(volume: Tensor, weights: Tensor) -> Tensor:
    r"""Local guided aggregation (LGA): a filter of 5 x 5 pixels and 3 planes whose weights differ from pixel to pixel.

    .. math::
        y(p, d) = \sum_{k=-1}^{1} \sum_{r=-2}^{2} \sum_{c=-2}^{2} w_{krc}(p)\, x(p + (r, c), d + k)

    A neighbour outside of the image or of the planes is replaced by :math:`x(p, d)`. The weights of a pixel are divided
    by the sum of their absolute values, so that they keep their signs.

    It has a gradient, but no second one. Nothing but the volume and the weights is kept for it.

    Args:
        volume: x, (B, D, H, W).
        weights: w, (B, 75, H, W), the planes k in the outer order, then r, then c.

    Returns:
        y, (B, D, H, W).

    Raises:
        InputError: volume and weights that do not fit.

    Source: Zhang et al., "GA-Net: guided aggregation net for end-to-end stereo matching", CVPR 2019, section 3.2.

    >>> local_guided_aggregate(torch.full((1, 4, 3, 5), 2.0), torch.ones(1, 75, 3, 5)).round(decimals=5).unique()
    tensor([2.])
    """
    if volume.dim() != 4 or weights.dim() != 4 or weights.shape[1] != WEIGHTS:
        raise InputError(
            f"local guided aggregation wants a volume (B, D, H, W) and weights (B, {WEIGHTS}, H, W); got "
            f"{tuple(volume.shape)} and {tuple(weights.shape)}"
        )
    weights = F.normalize(at_least_float32(weights), p=1.0, dim=1, eps=1e-12).to(volume.dtype)
    weights = _with_missing(weights)
    if torch.compiler.is_exporting():
        return _filter(_padded(volume), volume, weights)
    result: Tensor = _LocalFilter.apply(volume, weights)
    return result


@REGRESSIONS.register("local_guided")
class LocalGuidedSoftArgmin(nn.Module):
    r"""Soft-argmin of logits that `local_guided_aggregate` filters, ahead of the softmax and behind it.

    .. math::
        p = F_2(F_2(\mathrm{softmax}(F_1(F_1(c))))), \qquad
        \hat d = \frac{\sum_d x_d\, p_d}{\sum_d |p_d|}

    :math:`F_1` and :math:`F_2` are the aggregation by two sets of weights, each from two convolutions of the guide.
    Weights may be negative, and so may p: an estimate can lie outside of the candidates by a little.

    Without guides, as the heads for training have it, it is `soft_argmin`.

    Args:
        guide_channels: of the guides, by stride.
        stride: of the logits, and so of the guide that is read.
        channels: between the two convolutions.

    Raises:
        ConfigError: there is no guide at this stride.

    Shape: logits (B, D, H, W) and guides by stride to (B, H, W).

    Source: Zhang et al., "GA-Net: guided aggregation net for end-to-end stereo matching", CVPR 2019, sections 3.2 and
    3.3.

    >>> regression = LocalGuidedSoftArgmin(guide_channels={1: 3})
    >>> regression(torch.rand(1, 12, 8, 16), guides={1: torch.rand(1, 3, 8, 16)}).shape
    torch.Size([1, 8, 16])
    """

    min_levels = 1

    def __init__(self, *, guide_channels: Mapping[int, int], stride: int = 1, channels: int = 16) -> None:
        super().__init__()
        if stride not in guide_channels:
            raise ConfigError(
                f"the regression 'local_guided' of logits at stride {stride} wants a guide there; there are guides at "
                f"{', '.join(map(str, guide_channels))}"
            )
        self.stride = stride
        self.guide_channels = {stride: guide_channels[stride]}
        self.of_logits, self.of_probability = (_weights(guide_channels[stride], channels) for _ in range(2))

    def forward(self, logits: Tensor, candidates: Tensor | None = None, guides: Guides | None = None) -> Tensor:
        """Logits (B, D, H, W) and guides to (B, H, W)."""
        if guides is None:
            return soft_argmin(logits, candidates)
        return expectation(self._probability(logits, guides[self.stride]), candidates)

    def with_confidence(
        self, logits: Tensor, candidates: Tensor | None = None, guides: Guides | None = None
    ) -> tuple[Tensor, Tensor]:
        """Estimate and probability mass of the four candidates nearest to it, both (B, H, W), as of a soft-argmin."""
        probability = softmax(logits) if guides is None else self._probability(logits, guides[self.stride])
        estimate = expectation(probability, candidates)
        return estimate, mass_near(probability.abs(), estimate, candidates)

    def _probability(self, logits: Tensor, guide: Tensor) -> Tensor:
        weights = self.of_logits(guide)
        for _ in range(2):
            logits = local_guided_aggregate(logits, weights)
        probability = softmax(logits)
        weights = self.of_probability(guide)
        for _ in range(2):
            probability = local_guided_aggregate(probability, weights)
        return F.normalize(probability, p=1.0, dim=1, eps=1e-12)


def _weights(guide_channels: int, channels: int) -> nn.Sequential:
    last = nn.Conv2d(channels, WEIGHTS, 3, padding=1, bias=False)
    init_convolutions(last)
    return nn.Sequential(ConvNormAct(guide_channels, channels, activation=relu), last)


class _LocalFilter(torch.autograd.Function):
    """`_filter`, with a backward pass that keeps no product."""

    @staticmethod
    def forward(ctx: Any, volume: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(volume, weights)
        padded, result = _padded(volume), torch.empty_like(volume)
        for rows in _bands(volume):
            result[:, :, rows] = _filter(padded, volume, weights, rows)
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        volume, weights = ctx.saved_tensors
        padded, to_weights = _padded(volume), torch.empty_like(weights)
        to_padded = torch.zeros_like(padded)
        for rows in _bands(volume):
            g, w = gradient[:, :, rows], weights[:, :, rows]
            for j, view in enumerate(_neighbors(volume, rows)):
                to_padded[view].addcmul_(g, w[:, j : j + 1])
                to_weights[:, j, rows] = (g * padded[view]).sum(1)
        to_volume = to_padded[:, 1:-1, REACH:-REACH, REACH:-REACH]
        whole, first, last = weights[:, WEIGHTS:].unsqueeze(2).unbind(1)
        to_volume.addcmul_(gradient, whole)
        to_volume[:, :1].addcmul_(gradient[:, :1], first)
        to_volume[:, -1:].addcmul_(gradient[:, -1:], last)
        products = gradient * volume
        to_weights[:, WEIGHTS:] = torch.stack((products.sum(1), products[:, 0], products[:, -1]), dim=1)
        return to_volume, to_weights


def _filter(padded: Tensor, volume: Tensor, weights: Tensor, rows: slice = slice(None)) -> Tensor:
    """A band of rows, filtered by the weights (B, 75 + 3, H, W): of the neighbours, and of what stands for them."""
    x, w = volume[:, :, rows], weights[:, :, rows]
    whole, first, last = w[:, WEIGHTS:].unsqueeze(2).unbind(1)
    result = x * whole
    result = torch.cat((result[:, :1] + first * x[:, :1], result[:, 1:]), dim=1)
    result = torch.cat((result[:, :-1], result[:, -1:] + last * x[:, -1:]), dim=1)
    for j, view in enumerate(_neighbors(volume, rows)):
        result = result.addcmul_(padded[view], w[:, j : j + 1])
    return result


def _with_missing(weights: Tensor) -> Tensor:
    """The weights (B, 75, H, W), and three more: of what is outside of the image, and of the planes at either end."""
    by_plane = weights.reshape(len(weights), PLANES, WINDOW**2, *weights.shape[-2:])
    height, width = weights.shape[-2:]
    ones = F.pad(torch.ones_like(weights[0, 0]), [REACH] * 4)
    inside = torch.stack([ones[r : r + height, c : c + width] for r in range(WINDOW) for c in range(WINDOW)])
    outside = (by_plane * (1 - inside)).sum((1, 2))
    first, last = ((by_plane[:, k] * inside).sum(1) for k in (0, -1))
    return torch.cat((weights, torch.stack((outside, first, last), dim=1)), dim=1)


def _padded(volume: Tensor) -> Tensor:
    """Zeros around it, where neighbours are missing."""
    return F.pad(volume, (REACH, REACH, REACH, REACH, 1, 1))


def _neighbors(volume: Tensor, rows: slice) -> Iterator[tuple[slice, ...]]:
    """For each weight, where its neighbours lie in the padded volume."""
    planes, height, width = volume.shape[1:]
    start, stop = rows.start or 0, height if rows.stop is None else rows.stop
    for k in range(PLANES):
        for r in range(WINDOW):
            for c in range(WINDOW):
                yield (slice(None), slice(k, k + planes), slice(start + r, stop + r), slice(c, c + width))


def _bands(volume: Tensor) -> Iterator[slice]:
    """Rows that are filtered at a time: all of them on a GPU."""
    batch, planes, height, width = volume.shape
    step = max(1, BAND // (batch * planes * width)) if volume.device.type == "cpu" else height
    for start in range(0, height, step):
        yield slice(start, min(start + step, height))
