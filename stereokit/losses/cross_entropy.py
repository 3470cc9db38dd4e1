"""Cross-entropy of distributions over disparity."""

import torch
from torch import Tensor

from stereokit.errors import InputError
from stereokit.layers import at_least_float32
from stereokit.metrics import valid_pixels

__all__ = ["masked_cross_entropy", "truth_of_cells"]


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
