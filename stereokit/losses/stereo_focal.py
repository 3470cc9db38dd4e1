"""The loss of AcfNet: a peak around the truth, as wide as the network is unsure."""

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from stereokit.contracts import Distribution, Prediction
from stereokit.errors import ConfigError, InputError
from stereokit.layers import at_least_float32
from stereokit.losses.cross_entropy import distribution_of, known_cells, regressed_from, truth_of_cells
from stereokit.losses.known import mean_over_known
from stereokit.losses.smooth_l1 import SmoothL1
from stereokit.metrics import valid_pixels
from stereokit.registry import LOSSES

__all__ = ["StereoFocal", "confidence_loss", "stereo_focal_loss", "unimodal_target"]


def unimodal_target(levels: Tensor, truth: Tensor, scale: Tensor | float) -> Tensor:
    r"""A Laplace distribution around the truth, over levels.

    .. math:: P(l) = \mathrm{softmax}_l\left(-\frac{|x_l - g|}{b}\right)

    Args:
        levels: x, broadcastable to (B, L, H, W).
        truth: g, (B, H, W).
        scale: b, (B, H, W), or one for all; in the unit of the levels.

    Returns:
        (B, L, H, W).

    Source: Zhang et al., "Adaptive unimodal cost volume filtering for deep stereo matching", AAAI 2020, "unimodal
    ground truth distribution".

    >>> levels = torch.arange(3.0).reshape(1, -1, 1, 1)
    >>> unimodal_target(levels, torch.ones(1, 1, 1), 1.0).flatten()
    tensor([0.2119, 0.5761, 0.2119])
    """
    apart = (levels - truth.unsqueeze(1)).abs()
    return (-apart / (scale.unsqueeze(1) if isinstance(scale, Tensor) else scale)).softmax(1)


def stereo_focal_loss(
    distribution: Distribution,
    truth: Tensor,
    *,
    scale: Tensor | float = 1.2,
    focus: float = 5.0,
    max_disparity: float | None = None,
) -> Tensor:
    r"""Mean cross-entropy with `unimodal_target`, in which levels count for more where the target is large.

    .. math:: L = -\frac{1}{N} \sum_i \sum_l (1 - P_i(l))^{-\gamma} P_i(l) \log p_i(l)

    Args:
        distribution: its logits, (B, L, h, w), give p; its planes are x. Offsets do not count.
        truth: (B, H, W), pixels; 0, negative and non-finite values are unknown. Each cell of the logits goes by the
            pixel in its middle; the logits may reach beyond, where the images were padded.
        scale: b of the target, in distances between planes (AcfNet's are 1 px apart); one for all, or (B, h, w).
        focus: gamma; 0 for the plain cross-entropy.
        max_disparity: as in `masked_smooth_l1`.

    Returns:
        A scalar; 0, with a gradient of 0, where no cell is known.

    Raises:
        InputError: the logits do not cover the ground truth, or there is one level alone.

    Source: Zhang et al., "Adaptive unimodal cost volume filtering for deep stereo matching", AAAI 2020, "stereo focal
    loss".

    >>> flat = Distribution(torch.zeros(1, 4, 1, 1), stride=1, spacing=2.0)
    >>> round(stereo_focal_loss(flat, torch.full((1, 1, 1), 3.0), focus=0.0).item(), 4)  # log 4
    1.3863
    """
    cells, known, logits = known_cells(distribution, truth, max_disparity)
    if logits.shape[1] < 2:
        raise InputError("the stereo focal loss is for two levels and more; got one")
    levels = _in_planes(distribution, cells, known)
    log_mass = at_least_float32(logits).log_softmax(1)
    if isinstance(scale, Tensor):
        scale = _where_known(scale, known, otherwise=1).to(log_mass.dtype)
    target = unimodal_target(levels.to(log_mass.dtype), torch.zeros_like(cells, dtype=log_mass.dtype), scale)
    weight = (1 - target).clamp(min=torch.finfo(target.dtype).eps) ** -focus
    return mean_over_known(-(weight * target * log_mass).sum(1), known)


def _in_planes(distribution: Distribution, cells: Tensor, known: Tensor) -> Tensor:
    """How far each level lies from the truth of its cell, in distances between planes."""
    rows, columns = cells.shape[1:]
    planes = distribution._replace(offsets=None).disparities()[:, :, :rows, :columns].detach()
    apart: Tensor | float = distribution.spacing
    if distribution.values is not None:
        apart = ((planes[:, -1:] - planes[:, :1]) / (planes.shape[1] - 1)).clamp(min=1e-6)
    return (planes - torch.where(known, cells, 0).unsqueeze(1)) / apart


def confidence_loss(certainty: Tensor, known: Tensor) -> Tensor:
    r"""Mean of :math:`-\log f` over the known cells, for the confidence :math:`f = \sigma(c)`.

    Args:
        certainty: c, (B, h, w), at least as large as `known`.
        known: (B, H, W), bool.

    Returns:
        A scalar; 0, with a gradient of 0, where no cell is known.

    Source: Zhang et al., AAAI 2020, "confidence estimation network".

    >>> round(confidence_loss(torch.zeros(1, 1, 1), torch.ones(1, 1, 1, dtype=torch.bool)).item(), 4)  # log 2
    0.6931
    """
    return mean_over_known(-F.logsigmoid(_where_known(at_least_float32(certainty), known)), known)


def _where_known(values: Tensor, known: Tensor, otherwise: float = 0) -> Tensor:
    """Values (B, h, w) at the known cells; what is said of the others must not reach the gradient, not as 0 * nan."""
    return torch.where(known, values[:, : known.shape[1], : known.shape[2]], otherwise)


@LOSSES.register("stereo_focal")
class StereoFocal:
    r"""The loss of AcfNet: `stereo_focal_loss`, shares of smooth L1 and, where there is a confidence, its loss.

    .. math:: L = L_{focal} + \lambda_d L_{smooth_1} + \lambda_c L_{confidence}

    Where the network says how sure it is, f, the target is `narrowest` where f is 1 and `widest` where it is 0: this
    teaches it the confidence, and the confidence loss keeps it from being unsure everywhere. The inner values of the
    focal loss are computed anew in the backward pass, in place of being kept.

    Args:
        focus: gamma of the focal loss.
        scale: of the target, in distances between planes, where the network gives no confidence.
        narrowest: of the target, where it does.
        widest: likewise.
        smooth_l1: share of smooth L1.
        confidence: share of `confidence_loss`, where there is a confidence.

    Raises:
        ConfigError: a scale that is not above 0, a negative share, or widths in the wrong order.

    Source: Zhang et al., "Adaptive unimodal cost volume filtering for deep stereo matching", AAAI 2020; with the shares
    and scales of the authors' code.

    >>> flat = Distribution(torch.zeros(1, 4, 1, 1), stride=1, spacing=1.0)
    >>> prediction = Prediction(torch.ones(1, 1, 1), 1, flat)
    >>> round(StereoFocal(focus=0.0)(prediction, torch.ones(1, 1, 1), max_disparity=None).item(), 4)
    1.3863
    """

    def __init__(
        self,
        *,
        focus: float = 5.0,
        scale: float = 1.2,
        narrowest: float = 1.0,
        widest: float = 2.0,
        smooth_l1: float = 0.1,
        confidence: float = 8.0,
    ) -> None:
        for name, value in (("scale", scale), ("narrowest", narrowest)):
            if not value > 0:
                raise ConfigError(f"{name}={value!r} of the target has to be above 0")
        if not widest >= narrowest:
            raise ConfigError(f"widest={widest!r} of the target is below narrowest={narrowest!r}")
        for name, value in (("focus", focus), ("smooth_l1", smooth_l1), ("confidence", confidence)):
            if not value >= 0:
                raise ConfigError(f"{name}={value!r} has to be 0 or more")
        self.focus, self.scale, self.narrowest, self.widest = focus, scale, narrowest, widest
        self.shares = smooth_l1, confidence
        self.smooth = SmoothL1()

    def __call__(self, prediction: Prediction, truth: Tensor, *, max_disparity: float | None) -> Tensor:
        """The mean over the known cells.

        Raises:
            ConfigError: the prediction comes from no distribution.
        """
        distribution_of(prediction, "stereo_focal")
        smooth_share, confidence_share = self.shares
        loss: Tensor = checkpoint(self._focal, prediction, truth, max_disparity, use_reentrant=False)
        if smooth_share:
            loss = loss + smooth_share * self.smooth(prediction, truth, max_disparity=max_disparity)
        head = prediction.distribution
        if confidence_share and head is not None and head.certainty is not None:
            known = valid_pixels(truth_of_cells(truth, head.stride), max_disparity=max_disparity)
            loss = loss + confidence_share * confidence_loss(head.certainty, known)
        return loss

    def _focal(self, prediction: Prediction, truth: Tensor, max_disparity: float | None) -> Tensor:
        seen = regressed_from(prediction, "stereo_focal")
        scale: Tensor | float = self.scale
        if seen.certainty is not None:
            known = valid_pixels(truth_of_cells(truth, seen.stride), max_disparity=max_disparity)
            unsure = (-_where_known(at_least_float32(seen.certainty), known)).sigmoid()
            scale = self.narrowest + (self.widest - self.narrowest) * unsure
        return stereo_focal_loss(seen, truth, scale=scale, focus=self.focus, max_disparity=max_disparity)
