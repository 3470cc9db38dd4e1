"""Training losses over the known pixels: smooth L1 of the disparities, cross-entropy of the distributions."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from stereokit.errors import InputError
from stereokit.layers import at_least_float32
from stereokit.metrics import valid_pixels
from stereokit.model import StereoOutput

__all__ = ["masked_cross_entropy", "masked_smooth_l1", "stereo_loss", "truth_of_cells"]


def masked_smooth_l1(disparity: Tensor, truth: Tensor, *, max_disparity: float | None = None) -> Tensor:
    r"""Mean smooth-L1 distance over the pixels with known ground truth.

    .. math:: L = \frac{1}{N} \sum_{i:\, 0 < g_i < D} \mathrm{smooth}_{L_1}(g_i - \hat d_i)

    Args:
        disparity: estimate, (B, H, W), pixels.
        truth: g, (B, H, W), pixels; 0, negative and non-finite values are unknown.
        max_disparity: D; ground truth from there up does not count. None counts every known pixel.

    Returns:
        A scalar; 0, with a gradient of 0, where no pixel is known.

    Raises:
        InputError: the shapes differ, or a ceiling that leaves nothing.

    Source: CoEx, equation "smooth L1".

    >>> masked_smooth_l1(torch.tensor([[[1.0, 9.0]]]), torch.tensor([[[3.0, torch.nan]]])).item()
    1.5
    """
    if disparity.shape != truth.shape:
        raise InputError(
            f"estimate and ground truth differ in shape: {tuple(disparity.shape)} and {tuple(truth.shape)}"
        )
    known = valid_pixels(truth, max_disparity=max_disparity)
    target = torch.where(known, truth, disparity.detach())
    distance = F.smooth_l1_loss(disparity, target.to(disparity.dtype), reduction="none")
    return torch.where(known, distance, 0).sum() / known.sum().clamp(min=1)


def truth_of_cells(truth: Tensor, stride: int) -> Tensor:
    """Ground truth (B, H, W) in the middle of each cell of `stride` x `stride` pixels; a mean would mix surfaces.

    >>> truth_of_cells(torch.arange(32.0).reshape(1, 4, 8), stride=4)
    tensor([[[18., 22.]]])
    """
    return truth[:, stride // 2 :: stride, stride // 2 :: stride]


def masked_cross_entropy(
    logits: Tensor, truth: Tensor, *, stride: int, first_level: float = 0.0, max_disparity: float | None = None
) -> Tensor:
    r"""Mean cross-entropy between the distribution over the levels and the truth, split between its two levels.

    .. math::
        L = -\frac{1}{N} \sum_i (1 - w_i) \log p_i(l_i) + w_i \log p_i(l_i + 1), \quad
        l_i + w_i = \frac{g_i - x_0}{s}, \ 0 \le w_i < 1

    Where it is least, these two hold all of the mass, and soft-argmin gives the truth, as does top-k from k = 2 on.
    Smooth L1 behind a top-k regression moves the k largest logits alone; this moves all of them.

    Args:
        logits: of p, (B, L, h, w), larger is better.
        truth: g, (B, H, W), pixels; 0, negative and non-finite values are unknown. Each cell of the logits goes by the
            pixel in its middle; the logits may reach beyond, where the images were padded.
        stride: s, pixels of a level, and of a cell in height and width.
        first_level: x_0, the disparity of the first level, in pixels; see `StereoModel.first_level`.
        max_disparity: as in `masked_smooth_l1`.

    Returns:
        A scalar; 0, with a gradient of 0, where no cell is known.

    Raises:
        InputError: the logits do not cover the ground truth.

    Source: the sub-pixel cross-entropy of Tulyakov et al., "Practical Deep Stereo (PDS)", NeurIPS 2018, which has a
    Laplace distribution around the truth in place of the two levels.

    >>> logits = torch.tensor([0.0, 0.0, -torch.inf]).reshape(1, 3, 1, 1)
    >>> round(masked_cross_entropy(logits, torch.full((1, 4, 4), 2.0), stride=4).item(), 4)  # log 2: half of each level
    0.6931
    """
    cells = truth_of_cells(truth, stride)
    rows, columns = cells.shape[1:]
    if logits.dim() != 4 or logits.shape[0] != len(truth) or logits.shape[2] < rows or logits.shape[3] < columns:
        raise InputError(
            f"ground truth {tuple(truth.shape)} at stride {stride} wants logits of at least "
            f"({len(truth)}, L, {rows}, {columns}); got {tuple(logits.shape)}"
        )
    known = valid_pixels(cells, max_disparity=max_disparity)
    last = logits.shape[1] - 1
    position = torch.where(known, (cells - first_level) / stride, 0).clamp(0, last).unsqueeze(1)
    lower = position.floor().clamp(max=max(last - 1, 0))
    log_mass = at_least_float32(logits[:, :, :rows, :columns]).log_softmax(1)
    share = (position - lower).to(log_mass.dtype)
    below, above = (log_mass.gather(1, level.clamp(max=last).long()) for level in (lower, lower + 1))
    # a level without a share may be impossible: 0 times -inf is 0
    entropy = -torch.where(share < 1, (1 - share) * below, 0) - torch.where(share > 0, share * above, 0)
    return torch.where(known, entropy.squeeze(1), 0).sum() / known.sum().clamp(min=1)


def stereo_loss(
    output: StereoOutput,
    truth: Tensor,
    *,
    auxiliary_weights: Sequence[float],
    max_disparity: float | None = None,
) -> Tensor:
    """Weighted mean of `masked_smooth_l1` over the outputs of a network, the final one with weight 1.

    Args:
        output: of a network in training mode.
        truth: (B, H, W), pixels; 0, negative and non-finite values are unknown.
        auxiliary_weights: one per auxiliary disparity; `StereoModel.auxiliary_weights` are those of the papers.
        max_disparity: as in `masked_smooth_l1`.

    Raises:
        InputError: there are not as many weights as auxiliary disparities.

    >>> output = StereoOutput(torch.ones(1, 2, 2), auxiliary=(torch.zeros(1, 2, 2),))
    >>> stereo_loss(output, torch.ones(1, 2, 2), auxiliary_weights=(1,)).item()
    0.25
    """
    if len(auxiliary_weights) != len(output.auxiliary):
        raise InputError(
            f"{len(auxiliary_weights)} auxiliary weights for {len(output.auxiliary)} auxiliary disparities; a network "
            "gives them in training mode only, with their weights in model.auxiliary_weights"
        )
    total = masked_smooth_l1(output.disparity, truth, max_disparity=max_disparity)
    for weight, disparity in zip(auxiliary_weights, output.auxiliary, strict=True):
        total = total + weight * masked_smooth_l1(disparity, truth, max_disparity=max_disparity)
    return total / (1 + sum(auxiliary_weights))
