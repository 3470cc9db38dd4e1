"""Affinity: values that spread to their neighbours, by weights that a network decides."""

import itertools
from collections.abc import Iterator
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from stereokit.errors import ConfigError, InputError
from stereokit.layers.convolution import ConvNormAct, init_convolutions, relu

__all__ = [
    "AffinityCentre",
    "AffinityFusion",
    "AffinityPooling",
    "affinity_fuse",
    "affinity_pool",
    "affinity_propagate",
    "affinity_weights",
    "check_affinity",
]

AffinityCentre = Literal["input", "current", "own"]
"""What the centre of `affinity_propagate` is."""

LEAST = 1e-6


def affinity_weights(affinity: Tensor, *, signed: bool = True) -> Tensor:
    r"""Numbers made to weights whose absolute values sum to 1.

    .. math:: k_j = \frac{g_j}{\sum_i |g_i| + \epsilon}

    Args:
        affinity: g, (B, K, ...), any numbers.
        signed: keep the signs; else the absolute values are taken.

    Returns:
        (B, K, ...).

    Source: Cheng et al., "Learning depth with convolutional spatial propagation network", TPAMI 2019; the authors' code
    calls them "8sum" and "8sum_abs".

    >>> affinity_weights(torch.tensor([[1.0, -3.0]]))
    tensor([[ 0.2500, -0.7500]])
    """
    size = affinity.abs()
    return (affinity if signed else size) / (size.sum(1, keepdim=True) + LEAST)


def check_affinity(dims: int, steps: int, centre: AffinityCentre) -> None:
    """Raises `ConfigError` unless affinity can spread so."""
    if dims not in (2, 3):
        raise ConfigError(f"dims={dims!r}: affinity spreads in 2 or 3 dimensions")
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        raise ConfigError(f"steps={steps!r} of a propagation: a whole number from 1 up")
    if centre not in get_args(AffinityCentre):
        raise ConfigError(f"centre={centre!r} is unknown; use one of {', '.join(map(repr, get_args(AffinityCentre)))}")


def affinity_propagate(
    x: Tensor, affinity: Tensor, *, steps: int, signed: bool = True, centre: AffinityCentre = "input"
) -> Tensor:
    r"""Convolutional spatial propagation: each value becomes a weighed sum of its neighbours, several times over.

    .. math:: h_{t+1}(p) = \Bigl(1 - \sum_j k_j(p)\Bigr)\, h_c(p) + \sum_j k_j(p)\, h_t(p + o_j), \quad h_0 = x

    over the 8 neighbours of a pixel, or the 26 of a voxel, with `affinity_weights` k; outside of the map there are
    zeros. All channels share the weights. Papers and codes differ in the centre:

    - "input": :math:`h_c = x`, as in the authors' code. With absolute weights the centre vanishes.
    - "current": :math:`h_c = h_t`, as in the formula of the paper of 2018.
    - "own": the centre is one of the neighbours, with a weight of its own; nothing is left over.

    It has a gradient, but no second one. The input and the weights are kept for it, no step.

    Args:
        x: (B, C, H, W) or (B, C, D, H, W).
        affinity: g, (B, K, ...) of the size of x, any numbers. K is 8 or 26, or with "own" 9 or 27; the neighbours go
            in row-major order from the top left, of the plane before first. A dimension of size 1, such as that of the
            planes, is the same all along.
        steps: of the propagation.
        signed: as in `affinity_weights`.
        centre: what the centre is.

    Returns:
        Of the shape of x.

    Raises:
        InputError: an affinity of another shape.
        ConfigError: another centre, or no step.

    Source: Cheng et al., "Learning depth with convolutional spatial propagation network", TPAMI 2019.

    >>> x = torch.tensor([[0.0, 8.0, 0.0]]).reshape(1, 1, 1, 3)
    >>> affinity_propagate(x, torch.ones(1, 8, 1, 3), steps=1).round(decimals=4).abs().flatten()
    tensor([1., 0., 1.])
    """
    dims = x.dim() - 2
    check_affinity(dims, steps, centre)
    count = 3**dims - (centre != "own")
    fits = affinity.dim() == x.dim() and affinity.shape[1] == count
    if not fits or any(a not in (1, b) for a, b in zip(affinity.shape[2:], x.shape[2:], strict=True)):
        raise InputError(
            f"the propagation of {tuple(x.shape)} with the centre {centre!r} wants an affinity (B, {count}, ...) of "
            f"that size; got {tuple(affinity.shape)}"
        )
    weights = affinity_weights(affinity, signed=signed).to(x.dtype)
    rest: Tensor | None = None
    if centre != "own":
        left = 1 - weights.sum(1, keepdim=True)
        before, after = weights.chunk(2, dim=1)
        middle = torch.zeros_like(left) if centre == "input" else left
        weights = torch.cat((before, middle, after), dim=1)
        rest = left if centre == "input" else None
    if torch.compiler.is_compiling() or torch.compiler.is_exporting():
        state = x
        for _ in range(steps):
            state = _step(state, x, weights, rest)
        return state
    result: Tensor = _Propagation.apply(x, weights, rest, steps)
    return result


def affinity_pool(x: Tensor, affinity: Tensor, cell: int) -> Tensor:
    r"""Means over cells, weighed by an affinity: one step of propagation whose kernel and stride are the cell.

    .. math:: y(c) = \frac{\sum_{p \in c} |g(p)|\, x(p)}{\sum_{p \in c} |g(p)| + \epsilon}

    Equal weights give average pooling.

    Args:
        x: (B, C, H, W).
        affinity: g, (B, 1, H, W).
        cell: side; cells at the bottom and at the right may be cut.

    Returns:
        (B, C, ceil(H / cell), ceil(W / cell)).

    Source: Cheng et al., TPAMI 2019, "convolutional spatial pyramid pooling".

    >>> affinity_pool(torch.tensor([[2.0, 6.0]]).reshape(1, 1, 1, 2), torch.tensor([[[[3.0, -1.0]]]]), 2).flatten()
    tensor([3.0000])
    """
    height, width = x.shape[-2:]
    to_full_cells = [0, -width % cell, 0, -height % cell]
    weights = affinity.abs()
    total, mass = (F.avg_pool2d(F.pad(part, to_full_cells), cell) for part in (x * weights, weights))
    return total / (mass + LEAST / cell**2)


def affinity_fuse(branches: Tensor, affinity: Tensor) -> Tensor:
    r"""Maps fused to one: each pixel is a weighed sum over all of them and over its 3 x 3 neighbours.

    .. math:: y(p) = \sum_n \sum_{j=1}^{9} k_{nj}(p)\, x_n(p + o_j)

    with `affinity_weights` k over all branches and neighbours; outside of the maps there are zeros.

    Args:
        branches: x, (B, N, C, H, W).
        affinity: (B, N, 9, H, W), any numbers; neighbours in row-major order from the top left.

    Returns:
        (B, C, H, W).

    Raises:
        InputError: shapes that do not fit.

    Source: Cheng et al., TPAMI 2019, "convolutional feature fusion".

    >>> fused = affinity_fuse(torch.ones(1, 2, 1, 1, 1), torch.ones(1, 2, 9, 1, 1))
    >>> round(fused.item(), 4)  # one neighbour of nine is inside
    0.1111
    """
    count, height, width = branches.shape[1], *branches.shape[-2:]
    if tuple(affinity.shape[1:]) != (count, 9, height, width):
        raise InputError(
            f"the fusion of {count} maps wants an affinity (B, {count}, 9, {height}, {width}); got "
            f"{tuple(affinity.shape)}"
        )
    weights = affinity_weights(affinity.flatten(1, 2)).to(branches.dtype).reshape(affinity.shape)
    return sum(
        (_step(branches[:, n], None, weights[:, n], None) for n in range(1, count)),
        start=_step(branches[:, 0], None, weights[:, 0], None),
    )


class AffinityPooling(nn.Module):
    """`affinity_pool`, a convolution, and back to the size of the input.

    Args:
        channels: of the maps.
        cell: side.

    Source: Cheng et al., TPAMI 2019.

    >>> AffinityPooling(8, cell=4)(torch.rand(2, 8, 6, 9), torch.rand(2, 1, 6, 9)).shape
    torch.Size([2, 8, 6, 9])
    """

    def __init__(self, channels: int, cell: int) -> None:
        super().__init__()
        self.cell = cell
        self.conv = ConvNormAct(channels, channels, activation=relu)

    def forward(self, x: Tensor, affinity: Tensor) -> Tensor:
        """Maps (B, C, H, W) and affinity (B, 1, H, W) to (B, C, H, W)."""
        height, width = x.shape[-2:]
        pooled = self.conv(affinity_pool(x, affinity, self.cell))
        fine = F.interpolate(pooled, scale_factor=float(self.cell), mode="bilinear", align_corners=False)
        return fine[..., :height, :width]


class AffinityFusion(nn.Module):
    """`affinity_fuse` of several maps, with weights from a map beside them.

    Args:
        channels: of the map that decides.
        branches: how many maps are fused.

    Source: Cheng et al., TPAMI 2019.

    >>> AffinityFusion(8, branches=3)(torch.rand(2, 3, 4, 6, 9), torch.rand(2, 8, 6, 9)).shape
    torch.Size([2, 4, 6, 9])
    """

    def __init__(self, channels: int, branches: int) -> None:
        super().__init__()
        self.branches = branches
        self.affinity = ConvNormAct(channels, 9 * branches, activation=relu)

    def forward(self, branches: Tensor, guide: Tensor) -> Tensor:
        """Branches (B, N, C, H, W) and the guide (B, channels, H, W) to (B, C, H, W)."""
        batch, _, height, width = guide.shape
        return affinity_fuse(branches, self.affinity(guide).reshape(batch, self.branches, 9, height, width))


def affinity_convolution(in_channels: int, count: int, dims: int) -> nn.Conv2d | nn.Conv3d:
    """Makes affinities, by a plain convolution of kernel 3."""
    layer = (nn.Conv2d if dims == 2 else nn.Conv3d)(in_channels, count, 3, padding=1)
    init_convolutions(layer)
    return layer


def _views(shape: torch.Size) -> Iterator[tuple[Any, ...]]:
    """Where each neighbour of all pixels lies in the map with a border of one."""
    for offsets in itertools.product(range(3), repeat=len(shape)):
        yield (..., *(slice(o, o + side) for o, side in zip(offsets, shape, strict=True)))


def _step(state: Tensor, start: Tensor | None, weights: Tensor, rest: Tensor | None) -> Tensor:
    """One step, by weights (B, 3^n, ...) of all neighbours and the centre, and by that of what it began with."""
    padded = F.pad(state, [1, 1] * (state.dim() - 2))
    total = torch.zeros_like(state) if rest is None or start is None else rest * start
    for j, view in enumerate(_views(state.shape[2:])):
        total = torch.addcmul(total, padded[view], weights[:, j : j + 1])
    return total


class _Propagation(torch.autograd.Function):
    """All steps, with a backward pass that computes them again."""

    @staticmethod
    def forward(ctx: Any, start: Tensor, weights: Tensor, rest: Tensor | None, steps: int) -> Tensor:
        ctx.save_for_backward(start, weights, rest)
        ctx.steps = steps
        state = start
        for _ in range(steps):
            state = _step(state, start, weights, rest)
        return state

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        start, weights, rest = ctx.saved_tensors
        states = [start]
        for _ in range(ctx.steps - 1):
            states.append(_step(states[-1], start, weights, rest))
        to_weights = torch.zeros_like(weights)
        to_rest = None if rest is None else torch.zeros_like(rest)
        to_start = torch.zeros_like(start)
        inside: tuple[Any, ...] = (..., *(slice(1, -1) for _ in start.shape[2:]))
        for state in reversed(states):
            if rest is not None and to_rest is not None:
                to_start += gradient * rest
                to_rest += _summed(gradient * start, to_rest)
            padded = F.pad(state, [1, 1] * (state.dim() - 2))
            to_padded = torch.zeros_like(padded)
            for j, view in enumerate(_views(start.shape[2:])):
                to_padded[view].addcmul_(gradient, weights[:, j : j + 1])
                to_weights[:, j : j + 1] += _summed(gradient * padded[view], to_weights[:, j : j + 1])
            gradient = to_padded[inside]
        return to_start + gradient, to_weights, to_rest, None


def _summed(x: Tensor, like: Tensor) -> Tensor:
    """Over all that was broadcast."""
    broadcast = [axis for axis, (given, wanted) in enumerate(zip(x.shape, like.shape, strict=True)) if given != wanted]
    return x.sum(broadcast, keepdim=True) if broadcast else x
