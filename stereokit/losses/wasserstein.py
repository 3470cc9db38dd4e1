"""Wasserstein distances between distributions over disparity and the truth."""

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from stereokit.contracts import Distribution, Prediction
from stereokit.errors import ConfigError, InputError
from stereokit.layers import at_least_float32
from stereokit.losses.cross_entropy import distribution_of, known_cells, regressed_from
from stereokit.losses.known import mean_over_known
from stereokit.registry import LOSSES

__all__ = ["Wasserstein", "masked_wasserstein", "neighborhood_truth", "wasserstein_distance"]


def wasserstein_distance(first: Tensor, first_mass: Tensor, second: Tensor, second_mass: Tensor) -> Tensor:
    r"""The 1-Wasserstein distance between pairs of discrete distributions: how far mass has to be carried, in the mean.

    .. math:: W_1 = \int |F(x) - G(x)|\, dx

    with the cumulative distributions F and G, over the sorted points of both.

    Args:
        first: points (B, M, ...), in any order.
        first_mass: of each, (B, M, ...), with sum 1.
        second: points (B, N, ...), in any order.
        second_mass: of each, (B, N, ...), with sum 1.

    Returns:
        (B, ...), in the unit of the points.

    Source: Garg et al., "Wasserstein distances for stereo disparity estimation", NeurIPS 2020.

    >>> half = torch.tensor([[0.5, 0.5]])
    >>> wasserstein_distance(torch.tensor([[0.0, 4.0]]), half, torch.tensor([[7.0, 1.0]]), half)
    tensor([2.])
    """
    points, order = torch.cat((first, second), dim=1).sort(dim=1)
    mass = torch.cat((first_mass, -second_mass), dim=1).gather(1, order)
    return (mass.cumsum(1)[:, :-1].abs() * points.diff(dim=1)).sum(1)


def neighborhood_truth(truth: Tensor, known: Tensor, mass: float) -> tuple[Tensor, Tensor]:
    """The truth of each cell and of the eight around it, (B, 9, H, W), and the probability of each.

    Args:
        truth: (B, H, W).
        known: (B, H, W), bool. What is unknown or outside of the image leaves its share to the cell itself.
        mass: of the eight together.

    Source: Garg et al., NeurIPS 2020, "multi-modal ground truth".

    >>> values, mass = neighborhood_truth(torch.tensor([[[3.0, 5.0]]]), torch.ones(1, 1, 2, dtype=torch.bool), 0.2)
    >>> mass[0, :, 0, 0]
    tensor([0.0000, 0.0000, 0.0000, 0.0000, 0.9750, 0.0250, 0.0000, 0.0000, 0.0000])
    """
    height, width = truth.shape[-2:]
    values, there = (F.pad(x, (1, 1, 1, 1)) for x in (torch.where(known, truth, 0), known.to(truth.dtype)))
    views = [(..., slice(y, y + height), slice(x, x + width)) for y in range(3) for x in range(3)]
    around, shares = (torch.stack([x[view] for view in views], dim=1) for x in (values, there))
    shares = shares * (mass / 8)
    shares[:, 4] = 0
    shares[:, 4] = 1 - shares.sum(1)
    return around, shares


def masked_wasserstein(
    distribution: Distribution,
    truth: Tensor,
    *,
    power: int = 1,
    neighbors: float = 0.0,
    max_disparity: float | None = None,
) -> Tensor:
    r"""Mean Wasserstein distance between the distribution over the candidates and the truth.

    .. math:: L = \frac{1}{N} \sum_i \sum_j p_{ij}\, |x_{ij} - g_i|^q

    Where it is least, a candidate that lies at the truth holds all of the mass: it moves the logits and, where there
    are offsets, the candidates.

    Args:
        distribution: its logits, (B, D, h, w), give p; its planes with their offsets are x.
        truth: g, (B, H, W), pixels; 0, negative and non-finite values are unknown. Each cell of the logits goes by the
            pixel in its middle; the logits may reach beyond, where the images were padded.
        power: q, 1 or 2.
        neighbors: the probability that the truth is taken to have at the eight cells around (0.2 in the paper); above
            0, the distance is `wasserstein_distance`, over all points of both distributions, and `power` is 1.
        max_disparity: as in `masked_smooth_l1`.

    Returns:
        A scalar; 0, with a gradient of 0, where no cell is known.

    Raises:
        InputError: the logits do not cover the ground truth, or a power or probability that there is not.

    Source: Garg et al., "Wasserstein distances for stereo disparity estimation", NeurIPS 2020.

    >>> flat = Distribution(torch.zeros(1, 4, 1, 1), stride=1, spacing=2.0)
    >>> masked_wasserstein(flat, torch.full((1, 1, 1), 2.0)).item()  # of 0, 2, 4 and 6
    2.0
    """
    if power not in (1, 2) or not 0 <= neighbors < 1 or (neighbors and power != 1):
        raise InputError(
            f"a Wasserstein distance has power 1 or 2, and with neighbors, a probability below 1, power 1; got "
            f"power={power!r} and neighbors={neighbors!r}"
        )
    cells, known, logits = known_cells(distribution, truth, max_disparity)
    planes = _of_known_cells(distribution, known).disparities()
    mass = at_least_float32(logits).softmax(1)
    if neighbors:
        around, shares = neighborhood_truth(cells, known, neighbors)
        planes = planes.expand_as(mass).to(mass.dtype)
        return mean_over_known(wasserstein_distance(planes, mass, around.to(mass.dtype), shares.to(mass.dtype)), known)
    apart = (torch.where(known, cells, 0).unsqueeze(1) - planes).abs().to(mass.dtype)
    return mean_over_known((mass * (apart if power == 1 else apart.square())).sum(1), known)


def _of_known_cells(distribution: Distribution, known: Tensor) -> Distribution:
    """Cut to the cells (B, h, w); the offsets of unknown ones may be anything, and have no gradient."""
    rows, columns = known.shape[1:]
    values, offsets = distribution.values, distribution.offsets
    if values is not None and values.dim() == 4:
        values = values[:, :, :rows, :columns].detach()
    if offsets is not None:
        offsets = torch.where(known.unsqueeze(1), offsets[:, :, :rows, :columns], 0)
    return distribution._replace(values=values, offsets=offsets)


@LOSSES.register("wasserstein")
class Wasserstein:
    """`masked_wasserstein` of what a prediction was regressed from.

    Its inner values are computed anew in the backward pass, in place of being kept.

    Args:
        power: 1, or 2 for the squared distance.
        neighbors: probability that the truth has at the eight cells around.

    Raises:
        ConfigError: a power or probability that there is not.

    >>> prediction = Prediction(torch.ones(1, 1, 1), 1, Distribution(torch.zeros(1, 2, 1, 1), stride=1, spacing=4.0))
    >>> Wasserstein()(prediction, torch.ones(1, 1, 1), max_disparity=None).item()
    2.0
    """

    def __init__(self, *, power: int = 1, neighbors: float = 0.0) -> None:
        if isinstance(power, bool) or power not in (1, 2):
            raise ConfigError(f"power={power!r} of the Wasserstein distance: use 1 or 2")
        if not 0 <= neighbors < 1:
            raise ConfigError(f"neighbors={neighbors!r} is a probability, from 0 to below 1")
        if neighbors and power != 1:
            raise ConfigError(f"neighbors={neighbors!r} is for power=1; leave one of them out")
        self.power = power
        self.neighbors = neighbors

    def __call__(self, prediction: Prediction, truth: Tensor, *, max_disparity: float | None) -> Tensor:
        """The mean over the known cells.

        Raises:
            ConfigError: the prediction comes from no distribution.
        """
        distribution_of(prediction, "wasserstein")

        def measure() -> Tensor:
            return masked_wasserstein(
                regressed_from(prediction, "wasserstein"),
                truth,
                power=self.power,
                neighbors=self.neighbors,
                max_disparity=max_disparity,
            )

        loss: Tensor = checkpoint(measure, use_reentrant=False)
        return loss
