"""Candidates of each pixel, around what the stage before predicted."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import Candidates, Distribution, Features, Prediction
from stereokit.errors import ConfigError
from stereokit.registry import CANDIDATES

__all__ = ["DisparityRange", "NeighborhoodRange", "distribution_of", "spread_candidates"]


def spread_candidates(low: Tensor, high: Tensor, planes: int) -> Tensor:
    r"""Equally many steps between two disparities, both ends included.

    .. math:: x_n = l + \frac{n}{N - 1} (h - l), \quad n = 0 \ldots N - 1

    Args:
        low: l, (B, h, w).
        high: h, of the same shape.
        planes: N, at least 2.

    Returns:
        (B, N, h, w).

    >>> spread_candidates(torch.zeros(1, 1, 1), torch.full((1, 1, 1), 6.0), 3).flatten()
    tensor([0., 3., 6.])
    """
    share = torch.linspace(0, 1, planes, device=low.device, dtype=low.dtype).reshape(-1, 1, 1)
    return low.unsqueeze(1) + share * (high - low).unsqueeze(1)


class _AroundBefore(nn.Module):
    fixed = False

    def __init__(self, *, stride: int, planes: int, spacing: float, per_plane: int | None) -> None:
        super().__init__()
        per_plane = stride if per_plane is None else per_plane
        if planes < 2 or per_plane < 1 or planes % per_plane or not spacing > 0:
            raise ConfigError(
                f"planes={planes}, spacing={spacing} and per_plane={per_plane}: expected at least 2 candidates, more "
                "than 0 px apart, that fill the planes of the volume"
            )
        self.candidates = planes
        self.planes = planes // per_plane
        self.spacing = float(spacing)

    def extra_repr(self) -> str:
        """Number and spacing, for printing."""
        return f"candidates={self.candidates}, planes={self.planes}, spacing={self.spacing:g}"


def _of_before(before: Prediction | None, block: nn.Module) -> Prediction:
    if before is None:
        raise ConfigError(
            f"{type(block).__name__} looks around what the stage before predicted, and there is none; use it behind a "
            "coarse stage (coarse=[{...}]), and 'uniform' in the first"
        )
    return before


def distribution_of(before: Prediction | None, block: nn.Module) -> Distribution:
    """The distribution of the stage before; raises `ConfigError` where there is none."""
    distribution = _of_before(before, block).distribution
    if distribution is None:
        raise ConfigError(f"{type(block).__name__} wants a distribution from the stage before, which gives none")
    return distribution


@CANDIDATES.register("range")
class DisparityRange(_AroundBefore):
    r"""Candidates from :math:`\hat d - N s / 2` to :math:`\hat d + N s / 2`, both ends included.

    Args:
        stride: of the maps that are compared.
        planes: N, candidates of each pixel.
        spacing: s, in px.
        per_plane: candidates to each plane of the cost volume; None for the stride.

    Shape: a prediction (B, h, w) to candidates (B, N, h, w), at its resolution.

    Source: Gu et al., "Cascade cost volume for high-resolution multi-view stereo and stereo matching", CVPR 2020,
    section 3.2.

    >>> before = Prediction(torch.full((1, 1, 1), 20.0))
    >>> DisparityRange(stride=1, planes=3, spacing=2)(None, None, before).values.flatten()
    tensor([17., 20., 23.])
    """

    def __init__(self, *, stride: int, planes: int = 24, spacing: float = 1.0, per_plane: int | None = None) -> None:
        super().__init__(stride=stride, planes=planes, spacing=spacing, per_plane=per_plane)

    def forward(self, left: Features | None, right: Features | None, before: Prediction | None) -> Candidates:
        """What the stage before predicted to candidates."""
        middle = _of_before(before, self).disparity
        half = self.candidates * self.spacing / 2
        return Candidates(spread_candidates(middle - half, middle + half, self.candidates))


@CANDIDATES.register("neighborhood_range")
class NeighborhoodRange(_AroundBefore):
    """Candidates from the smallest to the largest disparity in the neighbourhood, at least N s px apart.

    The disparity is looked at in cells of `cell` x `cell` pixels. In each, the range is that of the cells within
    `window`, widened evenly where it is narrower than N s.

    Args:
        stride: of the maps that are compared.
        max_disparity: D, in px; the range ends there.
        planes: N, candidates of each pixel.
        spacing: s, in px.
        per_plane: candidates to each plane of the cost volume; None for the stride.
        window: of cells, odd.
        cell: in px.
        published: as the published weights were trained: the candidates are made a `cell`-th as many, interpolated in
            all three dimensions, so that the first ones of a pixel are equal and so are the last ones, and the range
            ends at `cell` times D.

    Shape: a prediction (B, h, w) to candidates (B, N, h, w), at its resolution.

    Source: Gu et al., "Cascade cost volume for high-resolution multi-view stereo and stereo matching", CVPR 2020; the
    neighbourhood is that of its published stereo networks.

    >>> before = Prediction(torch.full((1, 8, 8), 20.0))
    >>> candidates = NeighborhoodRange(stride=2, max_disparity=192, planes=24)(None, None, before).values
    >>> candidates.shape, candidates.min().item(), candidates.max().item()
    (torch.Size([1, 24, 8, 8]), 8.0, 32.0)
    """

    def __init__(
        self,
        *,
        stride: int,
        max_disparity: int,
        planes: int = 24,
        spacing: float = 1.0,
        per_plane: int | None = None,
        window: int = 3,
        cell: int = 4,
        published: bool = False,
    ) -> None:
        super().__init__(stride=stride, planes=planes, spacing=spacing, per_plane=per_plane)
        if window < 1 or window % 2 == 0:
            raise ConfigError(f"window={window} has no centre; use an odd one such as 3")
        if cell < 1 or (published and planes % cell):
            raise ConfigError(f"cell={cell} has to be at least 1 and, for published weights, to divide {planes} planes")
        self.max_disparity = max_disparity
        self.window = window
        self.cell = cell
        self.published = published

    def forward(self, left: Features | None, right: Features | None, before: Prediction | None) -> Candidates:
        """What the stage before predicted to candidates."""
        disparity = _of_before(before, self).disparity
        height, width = disparity.shape[-2:]
        cells = (height // self.cell, width // self.cell)
        coarse = F.interpolate(disparity.unsqueeze(1), cells, mode="bilinear", align_corners=False)
        high = self._largest(coarse)
        low = -self._largest(-coarse)
        missing = (self.candidates * self.spacing - (high - low)).clamp(min=0.0) / 2
        last = float(self.max_disparity * (self.cell if self.published else 1))
        # no whole number for a bound: ONNX takes two of one type
        low, high = (x.clamp(0.0, last).squeeze(1) for x in (low - missing, high + missing))
        if self.published:
            values = spread_candidates(low, high, self.candidates // self.cell)
            size = (self.candidates, height, width)
            return Candidates(F.interpolate(values.unsqueeze(1), size, mode="trilinear").squeeze(1))
        values = spread_candidates(low, high, self.candidates)
        return Candidates(F.interpolate(values, (height, width), mode="bilinear", align_corners=False))

    def _largest(self, x: Tensor) -> Tensor:
        return F.max_pool2d(x, self.window, stride=1, padding=self.window // 2)
