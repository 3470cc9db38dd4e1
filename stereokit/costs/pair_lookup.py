"""Correlation of all pairs of a row, looked up around a disparity, at several scales."""

from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.costs.shift import check_features
from stereokit.errors import ConfigError, InputError
from stereokit.layers import at_least_float32
from stereokit.runtime.memory import available_memory

__all__ = ["Lookup", "PairLookup", "Pairs", "correlation_pyramid", "look_up", "look_up_on_demand"]

Lookup = Literal["auto", "volume", "on_demand"]

GATHERED = 2**24
"""Features that `look_up_on_demand` gathers at once, about."""


def correlation_pyramid(left: Tensor, right: Tensor, levels: int) -> list[Tensor]:
    r"""Correlation of each left pixel with all right pixels of its row, and its means over 2, 4, ... of the latter.

    .. math:: C_0(y, x, x') = \frac{1}{\sqrt C} \sum_c l_c(y, x)\, r_c(y, x'), \quad
        C_{i+1}(y, x, x') = \tfrac12 (C_i(y, x, 2x') + C_i(y, x, 2x' + 1))

    Args:
        left: l, (B, C, h, w).
        right: r, likewise.
        levels: how many.

    Returns:
        (B, h, w, w), (B, h, w, w // 2), ...: of an odd number of columns the last one is left out.

    Raises:
        InputError: the maps are not a pair, or too narrow for the levels.

    Source: Lipson et al., "RAFT-Stereo: multilevel recurrent field transforms for stereo matching", 3DV 2021,
    section 3.2.

    >>> [tuple(level.shape) for level in correlation_pyramid(torch.rand(1, 4, 2, 9), torch.rand(1, 4, 2, 9), 3)]
    [(1, 2, 9, 9), (1, 2, 9, 4), (1, 2, 9, 2)]
    """
    check_features(left, right, 1)
    _check_width(right.shape[-1], levels)
    by_row = (at_least_float32(x).permute(0, 2, 3, 1) for x in (left / left.shape[1] ** 0.5, right))
    of_left, of_right = by_row
    pyramid = [of_left @ of_right.transpose(-1, -2)]
    for _ in range(levels - 1):
        pyramid.append(F.avg_pool2d(pyramid[-1], (1, 2)))
    return pyramid


def look_up(pyramid: Sequence[Tensor], disparity: Tensor, radius: int) -> Tensor:
    r"""The correlation around where a disparity points, at each level of a pyramid.

    .. math:: f_{i,k}(y, x) = C_i\Big(y, x, \frac{x - d(y, x)}{2^i} + k\Big), \quad k = -r \ldots r

    Between two columns it is interpolated linearly; outside it is 0.

    Args:
        pyramid: of `correlation_pyramid`.
        disparity: d, (B, h, w), in pixels of the maps.
        radius: r.

    Returns:
        (B, levels * (2 r + 1), h, w), level by level.

    Source: Lipson et al., "RAFT-Stereo", 3DV 2021, section 3.2.

    >>> pyramid = [torch.arange(6.0).expand(1, 1, 6, 6)]
    >>> look_up(pyramid, torch.full((1, 1, 6), 0.5), 1)[0, :, 0, 3]
    tensor([1.5000, 2.5000, 3.5000])
    """
    found = []
    for level, correlation in enumerate(pyramid):
        columns, share = _columns(disparity, level, radius)
        inside = (columns >= 0) & (columns < correlation.shape[-1])
        values = correlation.gather(-1, columns.clamp(0, correlation.shape[-1] - 1))
        found.append(_between(torch.where(inside, values, 0.0), share))
    return torch.cat(found, dim=-1).permute(0, 3, 1, 2)


def look_up_on_demand(left: Tensor, right: Tensor, disparity: Tensor, radius: int, levels: int) -> Tensor:
    """What `look_up` gives, computed from the features for the columns that are wanted alone.

    The pooling is linear, so that right features are pooled in place of their correlation. It holds no number for each
    pair of pixels, and takes the longer, the more often it is called: each time C multiplications for each of
    levels * (2 r + 2) columns, where `look_up` gathers.

    Args:
        left: (B, C, h, w).
        right: likewise.
        disparity: (B, h, w), in pixels of the maps.
        radius: r.
        levels: of the pyramid.

    Returns:
        (B, levels * (2 r + 1), h, w), level by level.

    Raises:
        InputError: the maps are not a pair, or too narrow for the levels.

    >>> left, right, d = torch.rand(1, 4, 2, 9), torch.rand(1, 4, 2, 9), torch.rand(1, 2, 9)
    >>> looked_up = look_up(correlation_pyramid(left, right, 2), d, 1)
    >>> torch.allclose(look_up_on_demand(left, right, d, 1, 2), looked_up, atol=1e-6)
    True
    """
    check_features(left, right, 1)
    _check_width(right.shape[-1], levels)
    height, width = left.shape[-2:]
    left, right = (at_least_float32(x) for x in (left / left.shape[1] ** 0.5, right))
    at_once = max(GATHERED // (left.shape[0] * left.shape[1] * width * (2 * radius + 2)), 1)
    found = []
    for level in range(levels):
        if level:
            right = F.avg_pool2d(right, (1, 2))
        rows = []
        for first in range(0, height, at_once):
            part = slice(first, first + at_once)
            columns, share = _columns(disparity[:, part], level, radius)
            inside = (columns >= 0) & (columns < right.shape[-1])
            flat = columns.clamp(0, right.shape[-1] - 1).flatten(2).unsqueeze(1)
            gathered = right[:, :, part].gather(-1, flat.expand(-1, right.shape[1], -1, -1))
            gathered = rearrange(gathered, "b c h (w k) -> b c h w k", k=columns.shape[-1])
            values = torch.einsum("bchw,bchwk->bhwk", left[:, :, part], gathered)
            rows.append(_between(torch.where(inside, values, 0.0), share))
        found.append(torch.cat(rows, dim=1))
    return torch.cat(found, dim=-1).permute(0, 3, 1, 2)


def _check_width(width: int, levels: int) -> None:
    if levels < 1 or width >> (levels - 1) < 1:
        raise InputError(
            f"a pyramid of {levels} levels wants maps of at least {2 ** max(levels - 1, 0)} columns; got {width}"
        )


def _columns(disparity: Tensor, level: int, radius: int) -> tuple[Tensor, Tensor]:
    """The whole columns around each place, (B, h, w, 2 r + 2), and where it lies between two of them."""
    x = torch.arange(disparity.shape[-1], device=disparity.device, dtype=disparity.dtype)
    place = (x - disparity) / 2**level
    whole = place.floor()
    steps = torch.arange(-radius, radius + 2, device=disparity.device)
    return whole.long().unsqueeze(-1) + steps, (place - whole).unsqueeze(-1)


def _between(values: Tensor, share: Tensor) -> Tensor:
    """Values at whole columns (..., n + 1), to those between, (..., n)."""
    return values[..., :-1] * (1 - share) + values[..., 1:] * share


class Pairs(NamedTuple):
    """What is looked up: of a pair of maps."""

    left: Tensor
    right: Tensor
    pyramid: list[Tensor] | None
    """None where it is computed on demand."""


class PairLookup(nn.Module):
    """`look_up` and `look_up_on_demand` as a module.

    Args:
        levels: of the pyramid.
        radius: in columns of each level.
        form: "volume" holds the correlation of all pairs of a row, 4 h w^2 bytes and as much again for the pyramid;
            "on_demand" computes what is looked up, each time; "auto" is the first where it fits into half of the
            memory that is free.

    Raises:
        ConfigError: no level, a negative radius, or another form.

    Source: Lipson et al., "RAFT-Stereo", 3DV 2021, section 3.2.

    >>> lookup = PairLookup(levels=2, radius=3)
    >>> pairs = lookup.of(*torch.rand(2, 1, 8, 4, 16))
    >>> lookup(pairs, torch.zeros(1, 4, 16)).shape
    torch.Size([1, 14, 4, 16])
    """

    def __init__(self, *, levels: int = 4, radius: int = 4, form: Lookup = "auto") -> None:
        super().__init__()
        if form not in get_args(Lookup):
            raise ConfigError(f"lookup={form!r} is unknown; use 'auto', 'volume' or 'on_demand'")
        if levels < 1 or radius < 0:
            raise ConfigError(f"levels={levels} and radius={radius} of a lookup: use at least 1 level and 0 columns")
        self.levels = levels
        self.radius = radius
        self.form = form
        self.out_channels = levels * (2 * radius + 1)

    def of(self, left: Tensor, right: Tensor) -> Pairs:
        """What `forward` looks at, of a pair of maps (B, C, h, w)."""
        on_demand = self.form == "on_demand" or (self.form == "auto" and not fits_into_memory(left))
        return Pairs(left, right, None if on_demand else correlation_pyramid(left, right, self.levels))

    def forward(self, pairs: Pairs, disparity: Tensor) -> Tensor:
        """Disparity (B, h, w), in pixels of the maps, to (B, out_channels, h, w)."""
        if pairs.pyramid is None:
            return look_up_on_demand(pairs.left, pairs.right, disparity, self.radius, self.levels)
        return look_up(pairs.pyramid, disparity, self.radius)

    def extra_repr(self) -> str:
        """Levels, radius and form, for printing."""
        return f"levels={self.levels}, radius={self.radius}, form={self.form!r}"


def fits_into_memory(maps: Tensor) -> bool:
    """Whether the correlation of all pairs of a row of such maps takes less than half of the memory that is free."""
    # a graph is made once, for any memory
    if torch.compiler.is_compiling():
        return True
    batch, _, height, width = maps.shape
    free = available_memory(maps.device)
    return free is None or 2 * 4 * batch * height * width**2 < free / 2
