"""The same candidates everywhere, equally far apart."""

import math

import torch
from torch import Tensor, nn

from stereokit.contracts import Candidates, Features, Prediction
from stereokit.errors import ConfigError
from stereokit.registry import CANDIDATES

__all__ = ["UniformCandidates"]


@CANDIDATES.register("uniform")
class UniformCandidates(nn.Module):
    """Disparities from 0 in equal steps, the same for each pixel.

    Args:
        max_disparity: D, in px.
        stride: of the maps that are compared.
        spacing: px between candidates; None for the stride, for which cost volumes have a fast form.
        include_end: whether D itself is one of them, as in GANet.
        per_plane: candidates to each plane of the cost volume, which lies in the middle of them. A volume of fewer
            planes is meant to be interpolated to the number of candidates before the regression, as in CasStereo.

    Raises:
        ConfigError: a spacing that is not above 0, or candidates that do not fill the planes.

    >>> UniformCandidates(max_disparity=192, stride=4).planes
    48
    >>> coarse = UniformCandidates(max_disparity=192, stride=4, spacing=4, per_plane=4)
    >>> coarse.planes, coarse(None, None, None).values.numel()
    (12, 48)
    """

    values: Tensor | None

    def __init__(
        self,
        *,
        max_disparity: int,
        stride: int,
        spacing: float | None = None,
        include_end: bool = False,
        per_plane: int = 1,
    ) -> None:
        super().__init__()
        self.spacing = float(stride if spacing is None else spacing)
        if not (self.spacing > 0 and math.isfinite(self.spacing)) or per_plane < 1:
            raise ConfigError(f"spacing={spacing!r} px and per_plane={per_plane!r} have to be above 0")
        count = int(max_disparity / self.spacing) + int(include_end)
        if count % per_plane or count == 0:
            raise ConfigError(
                f"{count} candidates up to {max_disparity} px, {self.spacing:g} px apart, do not fill planes of "
                f"{per_plane} each; use another max_disparity or per_plane"
            )
        self.planes = count // per_plane
        self.per_plane = per_plane
        self.fixed = self.spacing == stride and per_plane == 1
        values = None if self.fixed else torch.arange(count) * self.spacing
        self.register_buffer("values", values, persistent=False)

    def forward(self, left: Features | None, right: Features | None, before: Prediction | None) -> Candidates:
        """The candidates; neither the features nor what came before matter."""
        return Candidates(self.values)

    def extra_repr(self) -> str:
        """Number and spacing, for printing."""
        return f"planes={self.planes}, spacing={self.spacing:g}"
