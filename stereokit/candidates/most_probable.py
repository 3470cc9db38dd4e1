"""The candidates that the stage before finds most probable."""

from torch import Tensor, nn

from stereokit.candidates.neighborhood import distribution_of
from stereokit.contracts import Candidates, Features, Prediction
from stereokit.errors import ConfigError
from stereokit.layers import at_least_float32
from stereokit.registry import CANDIDATES

__all__ = ["MostProbable", "most_probable"]


def most_probable(logits: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """The k most probable levels of each pixel, in rising order, and their probability.

    Args:
        logits: (B, D, h, w).
        k: from 1 to D.

    Returns:
        Levels from 0 to D - 1, whole numbers, and the softmax over all D at these, (B, k, h, w) each.

    Source: Xu et al., "Accurate and efficient stereo matching via attention concatenation volume", TPAMI 2023,
    "Fast-ACV".

    >>> import torch
    >>> levels, probability = most_probable(torch.tensor([0.0, 9.0, -9.0, 9.0]).reshape(1, 4, 1, 1), k=2)
    >>> levels.flatten(), (probability.flatten() > 0.49).all()
    (tensor([1, 3]), tensor(True))
    """
    probability = at_least_float32(logits).softmax(1)
    levels = probability.topk(k, dim=1).indices.sort(dim=1).values
    return levels, probability.gather(1, levels)


@CANDIDATES.register("most_probable")
class MostProbable(nn.Module):
    """`most_probable` planes of the stage before; the volume is weighted by their probability.

    Args:
        stride: of the maps that are compared.
        planes: k, candidates of each pixel.

    Shape: a prediction with its distribution (B, D, h, w) to candidates and weights (B, k, h, w).

    Raises:
        ConfigError: in its forward, there is no distribution before, or one over fewer planes.

    Source: Xu et al., TPAMI 2023, "Fast-ACV".

    >>> import torch
    >>> from stereokit.contracts import Distribution
    >>> logits = torch.tensor([0.0, 9.0, -9.0, 9.0]).reshape(1, 4, 1, 1)
    >>> before = Prediction(torch.ones(1, 4, 4), distribution=Distribution(logits, stride=4, spacing=4.0))
    >>> MostProbable(stride=4, planes=2)(None, None, before).values.flatten()
    tensor([ 4., 12.])
    """

    fixed = False

    def __init__(self, *, stride: int, planes: int = 24) -> None:
        super().__init__()
        if planes < 1:
            raise ConfigError(f"planes={planes!r} has to be at least 1")
        self.planes = planes
        self.spacing = float(stride)

    def forward(self, left: Features | None, right: Features | None, before: Prediction | None) -> Candidates:
        """What the stage before predicted to candidates."""
        distribution = distribution_of(before, self)
        levels = distribution.logits.shape[1]
        if self.planes > levels:
            raise ConfigError(f"{self.planes} candidates are asked for, but the stage before has {levels} planes")
        index, weights = most_probable(distribution.logits, self.planes)
        values = distribution.values
        if values is None:
            return Candidates(distribution.first + distribution.spacing * index.to(weights.dtype), weights)
        values = values.reshape(1, -1, 1, 1) if values.dim() == 1 else values
        return Candidates(values.expand_as(distribution.logits).gather(1, index), weights)

    def extra_repr(self) -> str:
        """How many, for printing."""
        return f"planes={self.planes}"
