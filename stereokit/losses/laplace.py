"""Cross-entropy with a Laplace distribution around the truth."""

import torch
from torch import Tensor

from stereokit.contracts import Distribution, Prediction
from stereokit.errors import ConfigError
from stereokit.layers import at_least_float32
from stereokit.losses.cross_entropy import distribution_of, known_cells
from stereokit.losses.known import mean_over_known
from stereokit.registry import LOSSES

__all__ = ["LaplaceCrossEntropy", "laplace_cross_entropy"]


def laplace_cross_entropy(
    distribution: Distribution, truth: Tensor, *, scale: float = 1.0, max_disparity: float | None = None
) -> Tensor:
    r"""Mean cross-entropy between the distribution over the levels and a Laplace distribution around the truth.

    .. math::
        L = -\frac{1}{N} \sum_i \sum_l q_{il} \log p_i(l), \quad q_{il} \propto e^{-|g_i - x_l| / b}, \quad
        \sum_l q_{il} = 1

    Args:
        distribution: its logits, (B, L, h, w), give p; its planes are x. Offsets do not count.
        truth: g, (B, H, W), pixels; 0, negative and non-finite values are unknown. Each cell of the logits goes by the
            pixel in its middle; the logits may reach beyond, where the images were padded.
        scale: b, in pixels.
        max_disparity: as in `masked_smooth_l1`.

    Returns:
        A scalar; 0, with a gradient of 0, where no cell is known.

    Raises:
        InputError: the logits do not cover the ground truth.

    Source: Tulyakov et al., "Practical Deep Stereo (PDS): toward applications-friendly deep stereo matching",
    NeurIPS 2018, equation 5.

    >>> flat = Distribution(torch.zeros(1, 4, 1, 1), stride=1, spacing=2.0)
    >>> round(laplace_cross_entropy(flat, torch.full((1, 1, 1), 3.0)).item(), 4)  # log 4
    1.3863
    """
    cells, known, logits = known_cells(distribution, truth, max_disparity)
    values = distribution.values
    if values is None:
        levels = torch.arange(logits.shape[1], device=logits.device, dtype=cells.dtype)
        values = distribution.first + distribution.spacing * levels
    values = values.reshape(1, -1, 1, 1) if values.dim() == 1 else values.detach()
    rows, columns = cells.shape[1:]
    apart = (torch.where(known, cells, 0).unsqueeze(1) - values[:, :, :rows, :columns]).abs()
    log_mass = at_least_float32(logits).log_softmax(1)
    target = (-apart / scale).softmax(1).to(log_mass.dtype)
    return mean_over_known(-(target * log_mass).sum(1), known)


@LOSSES.register("laplace_cross_entropy")
class LaplaceCrossEntropy:
    """`laplace_cross_entropy` of a prediction's distribution.

    Args:
        scale: of the Laplace distribution, in pixels.

    Raises:
        ConfigError: a scale that is not above 0.

    >>> prediction = Prediction(torch.ones(1, 1, 1), 4, Distribution(torch.zeros(1, 2, 1, 1), stride=4, spacing=4))
    >>> round(LaplaceCrossEntropy()(prediction, torch.ones(1, 4, 4), max_disparity=None).item(), 4)
    0.6931
    """

    def __init__(self, *, scale: float = 1.0) -> None:
        if not scale > 0:
            raise ConfigError(f"scale={scale!r} px has to be above 0")
        self.scale = scale

    def __call__(self, prediction: Prediction, truth: Tensor, *, max_disparity: float | None) -> Tensor:
        """The mean over the known cells.

        Raises:
            ConfigError: the prediction comes from no distribution.
        """
        distribution = distribution_of(prediction, "laplace_cross_entropy")
        return laplace_cross_entropy(distribution, truth, scale=self.scale, max_disparity=max_disparity)
