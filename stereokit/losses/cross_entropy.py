"""Cross-entropy of distributions over disparity."""

import torch
from torch import Tensor

from stereokit.contracts import Distribution, Prediction
from stereokit.errors import ConfigError, InputError
from stereokit.layers import at_least_float32
from stereokit.losses.known import mean_over_known
from stereokit.losses.l1 import mean_of_cells
from stereokit.metrics import valid_pixels
from stereokit.registry import LOSSES

__all__ = ["CrossEntropy", "masked_cross_entropy", "truth_of_cells"]


def truth_of_cells(truth: Tensor, stride: int) -> Tensor:
    """Ground truth (B, H, W) in the middle of each cell of `stride` x `stride` pixels; a mean would mix surfaces.

    >>> truth_of_cells(torch.arange(32.0).reshape(1, 4, 8), stride=4)
    tensor([[[18., 22.]]])
    """
    return truth[:, stride // 2 :: stride, stride // 2 :: stride]


def masked_cross_entropy(distribution: Distribution, truth: Tensor, *, max_disparity: float | None = None) -> Tensor:
    r"""Mean cross-entropy between the distribution over the levels and the truth, split between its two levels.

    .. math::
        L = -\frac{1}{N} \sum_i (1 - w_i) \log p_i(l_i) + w_i \log p_i(l_i + 1), \quad
        g_i = (1 - w_i)\, x_{l_i} + w_i\, x_{l_i + 1}, \ 0 \le w_i < 1

    Where it is least, these two hold all of the mass, and soft-argmin gives the truth, as does top-k from k = 2 on.
    Smooth L1 behind a top-k regression moves the k largest logits alone; this moves all of them.

    Args:
        distribution: its logits, (B, L, h, w), give p; its planes are x. Offsets do not count.
        truth: g, (B, H, W), pixels; 0, negative and non-finite values are unknown. Each cell of the logits goes by the
            pixel in its middle; the logits may reach beyond, where the images were padded.
        max_disparity: as in `masked_smooth_l1`.

    Returns:
        A scalar; 0, with a gradient of 0, where no cell is known.

    Raises:
        InputError: the logits do not cover the ground truth.

    Source: the sub-pixel cross-entropy of Tulyakov et al., "Practical Deep Stereo (PDS)", NeurIPS 2018, which has a
    Laplace distribution around the truth in place of the two levels.

    >>> logits = torch.tensor([0.0, 0.0, -torch.inf]).reshape(1, 3, 1, 1)
    >>> half_of_each_level = Distribution(logits, stride=4, spacing=4)
    >>> round(masked_cross_entropy(half_of_each_level, torch.full((1, 4, 4), 2.0)).item(), 4)  # log 2
    0.6931
    """
    cells, known, logits = known_cells(distribution, truth, max_disparity)
    entropy, _ = two_level_entropy(distribution, cells, known, logits)
    return mean_over_known(entropy, known)


def two_level_entropy(
    distribution: Distribution, cells: Tensor, known: Tensor, logits: Tensor
) -> tuple[Tensor, Tensor]:
    """Cross-entropy of the truth that is split between its two levels, and the share of the upper one, (B, h, w)."""
    last = logits.shape[1] - 1
    lower, share = _split(distribution, cells, known, last)
    log_mass = at_least_float32(logits).log_softmax(1)
    share = share.to(log_mass.dtype)
    below, above = (log_mass.gather(1, level.clamp(max=last).long()) for level in (lower, lower + 1))
    # a level without a share may be impossible: 0 times -inf is 0
    entropy = -torch.where(share < 1, (1 - share) * below, 0) - torch.where(share > 0, share * above, 0)
    return entropy.squeeze(1), share.squeeze(1)


def known_cells(
    distribution: Distribution, truth: Tensor, max_disparity: float | None, *, mean: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """The truth of each cell (B, h, w), whether it is known, and the logits (B, L, h, w) of these cells.

    The truth is that of the pixel in the middle, or the mean of the known ones.
    """
    logits = distribution.logits
    if mean:
        cells, known = mean_of_cells(truth, distribution.stride, max_disparity=max_disparity)
    else:
        cells = truth_of_cells(truth, distribution.stride)
        known = valid_pixels(cells, max_disparity=max_disparity)
    rows, columns = cells.shape[1:]
    if logits.dim() != 4 or logits.shape[0] != len(truth) or logits.shape[2] < rows or logits.shape[3] < columns:
        raise InputError(
            f"ground truth {tuple(truth.shape)} at stride {distribution.stride} wants logits of at least "
            f"({len(truth)}, L, {rows}, {columns}); got {tuple(logits.shape)}"
        )
    # those of unknown cells may be anything, and have no gradient
    return cells, known, torch.where(known.unsqueeze(1), logits[:, :, :rows, :columns], 0)


def distribution_of(prediction: Prediction, loss: str) -> Distribution:
    """What a prediction comes from; raises `ConfigError` where there is none."""
    if prediction.distribution is None:
        raise ConfigError(
            f"the loss {loss!r} is for distributions over disparity, and this network predicts without one; use "
            "'smooth_l1'"
        )
    return prediction.distribution


def regressed_from(prediction: Prediction, loss: str) -> Distribution:
    """What a prediction was regressed from, at that resolution; raises `ConfigError` where there is no such thing."""
    distribution_of(prediction, loss)
    regressed = prediction.regressed()
    assert regressed is not None
    return regressed


def _split(distribution: Distribution, cells: Tensor, known: Tensor, last: int) -> tuple[Tensor, Tensor]:
    """The level at or below the truth, and the share of the one above it, (B, 1, h, w) each."""
    if distribution.values is None:
        position = (cells - distribution.first) / distribution.spacing
    else:
        rows, columns = cells.shape[1:]
        values = distribution.values
        values = values.reshape(1, -1, 1, 1) if values.dim() == 1 else values
        if tuple(values.shape[2:]) not in ((1, 1), tuple(distribution.logits.shape[2:])) or values.shape[1] != last + 1:
            raise InputError(
                f"the planes {tuple(values.shape)} are not those of the logits {tuple(distribution.logits.shape)}"
            )
        values = values[:, :, :rows, :columns].detach().expand(len(cells), -1, rows, columns)
        truth = cells.unsqueeze(1).nan_to_num(0, 0, 0)
        lower = ((values <= truth).sum(1, keepdim=True) - 1).clamp(0, max(last - 1, 0))
        under, over = (values.gather(1, (lower + i).clamp(max=last)) for i in (0, 1))
        position = (lower + ((truth - under) / (over - under).clamp(min=1e-6)).clamp(0, 1)).squeeze(1)
    position = torch.where(known, position, 0).clamp(0, last).unsqueeze(1)
    lower = position.floor().clamp(max=max(last - 1, 0))
    return lower, position - lower


@LOSSES.register("cross_entropy")
class CrossEntropy:
    """`masked_cross_entropy` of a prediction's distribution.

    >>> logits = torch.zeros(1, 2, 1, 1)
    >>> prediction = Prediction(torch.ones(1, 1, 1), 4, Distribution(logits, stride=4, spacing=4))
    >>> round(CrossEntropy()(prediction, torch.ones(1, 4, 4), max_disparity=None).item(), 4)
    0.6931
    """

    def __call__(self, prediction: Prediction, truth: Tensor, *, max_disparity: float | None) -> Tensor:
        """The mean over the known cells.

        Raises:
            ConfigError: the prediction comes from no distribution.
        """
        distribution = distribution_of(prediction, "cross_entropy")
        return masked_cross_entropy(distribution, truth, max_disparity=max_disparity)
