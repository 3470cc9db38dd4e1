"""Semi-global guided aggregation (SGA): costs gathered along image rows and columns, by weights that the image decides.

On a path the next pixel needs the one before, so there is one loop, over rows; columns are rows of the volume turned
around. The backward pass computes each of the four scans anew, in place of keeping them.
"""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from stereokit.errors import InputError
from stereokit.guidance.shapes import check_guide
from stereokit.layers import ConvNormAct, at_least_float32, init_convolutions, relu
from stereokit.registry import GUIDANCE

__all__ = ["SemiGlobalGuidance", "semi_global_aggregate"]

DIRECTIONS = 4
TERMS = 5


def semi_global_aggregate(volume: Tensor, weights: Tensor) -> Tensor:
    r"""Gathers a volume along four directions, and takes the largest of the four results.

    .. math::
        A_r(p, d) &= w_0 x(p, d) + w_1 A_r(q, d) + w_2 A_r(q, d - 1) + w_3 A_r(q, d + 1)
                     + w_4 \max_i A_r(q, i), \quad q = p - r \\
        y(p, d) &= \max_r A_r(p, d)

    The path goes down, up, to the right and to the left, from the edge. A term that is missing, outside of the image or
    of the planes, is replaced by :math:`x(p, d)`. The five weights of a pixel and direction are divided by the sum of
    their absolute values, so that they keep their signs.

    It has a gradient, but no second one. The volume, the weights and a byte per voxel are kept for it, no scan.

    Args:
        volume: x, (B, C, D, H, W).
        weights: w, (B, 4 * C * 5, H, W): direction, then channel, then term.

    Returns:
        y, (B, C, D, H, W).

    Raises:
        InputError: volume and weights that do not fit.

    Source: Zhang et al., "GA-Net: guided aggregation net for end-to-end stereo matching", CVPR 2019, section 3.1.

    >>> volume = torch.tensor([[8.0, 0.0, 0.0]]).reshape(1, 1, 1, 1, 3)
    >>> semi_global_aggregate(volume, torch.ones(1, 20, 1, 3)).flatten()
    tensor([8.0000, 3.2000, 1.2800])
    """
    batch, channels, _, height, width = volume.shape
    if weights.dim() != 4 or weights.shape[1] != DIRECTIONS * TERMS * channels:
        raise InputError(
            f"semi-global aggregation wants {DIRECTIONS * TERMS} weights for each of the {channels} channels, (B, "
            f"{DIRECTIONS * TERMS * channels}, H, W); got {tuple(weights.shape)}"
        )
    # (direction, term, B, C, 1, H, W)
    parts = weights.reshape(batch, DIRECTIONS, channels, TERMS, height, width).permute(1, 3, 0, 2, 4, 5).unsqueeze(4)
    parts = F.normalize(at_least_float32(parts), p=1.0, dim=1, eps=1e-12).to(volume.dtype)
    if torch.compiler.is_exporting():
        return torch.stack([_exported_scan(volume, parts[r], r) for r in range(DIRECTIONS)]).amax(0)
    result: Tensor = _SemiGlobal.apply(volume, parts)
    return result


@GUIDANCE.register("semi_global")
class SemiGlobalGuidance(nn.Module):
    r"""SGA block: `semi_global_aggregate` by weights from the image, a convolution, and a skip.

    .. math:: C_o = \mathrm{ReLU}(C_i + F^{3D}(\mathrm{SGA}(C_i, W * I)))

    Args:
        guide_channels: of the image features I.
        volume_channels: of the cost volume.

    Shape: volume (B, volume_channels, D, H, W) and guide (B, guide_channels, H, W) to the volume's shape.

    Raises:
        InputError: in its forward, volume and guide of other channels, or of sizes that differ.

    Source: Zhang et al., "GA-Net: guided aggregation net for end-to-end stereo matching", CVPR 2019, sections 3.1 and
    3.3.

    >>> block = SemiGlobalGuidance(guide_channels=96, volume_channels=8)
    >>> block(torch.rand(1, 8, 12, 16, 32), torch.rand(1, 96, 16, 32)).shape
    torch.Size([1, 8, 12, 16, 32])
    """

    def __init__(self, guide_channels: int, volume_channels: int) -> None:
        super().__init__()
        self.guide_channels = guide_channels
        self.volume_channels = volume_channels
        self.weights = nn.Conv2d(guide_channels, DIRECTIONS * TERMS * volume_channels, 3, padding=1, bias=False)
        init_convolutions(self.weights)
        self.norm = nn.BatchNorm3d(volume_channels)
        self.refine = ConvNormAct(volume_channels, volume_channels, dims=3, activation=None)
        self.activation = relu()

    def forward(self, volume: Tensor, guide: Tensor) -> Tensor:
        """Volume and guide to the aggregated volume."""
        check_guide(volume, guide, self.volume_channels, self.guide_channels)
        gathered = semi_global_aggregate(volume, self.weights(guide))
        return self.activation(self.refine(F.relu(self.norm(gathered))) + volume)


class _SemiGlobal(torch.autograd.Function):
    """The four scans and their maximum, with a backward pass that computes each scan again."""

    @staticmethod
    def forward(ctx: Any, volume: Tensor, weights: Tensor) -> Tensor:
        keeps = any(ctx.needs_input_grad)
        best = _scan(volume, weights[0], 0)
        chosen = torch.zeros_like(best, dtype=torch.uint8) if keeps else None
        for r in range(1, DIRECTIONS):
            scanned = _scan(volume, weights[r], r)
            if chosen is not None:
                chosen.masked_fill_(scanned > best, r)
            torch.maximum(best, scanned, out=best)
        if chosen is not None:
            ctx.save_for_backward(volume, weights, chosen)
        return best

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        volume, weights, chosen = ctx.saved_tensors
        to_volume, to_weights = torch.zeros_like(volume), torch.empty_like(weights)
        for r in range(DIRECTIONS):
            given = gradient * (chosen == r)
            _scan_backward(volume, weights[r], r, given, to_volume, to_weights[r])
        return to_volume, to_weights


def _turned(x: Tensor, direction: int) -> Tensor:
    """Columns in place of rows where the path goes to the right or left, so that it always goes along rows."""
    return x.transpose(-1, -2) if direction >= 2 else x


def _order(rows: int, direction: int) -> Iterable[int]:
    return range(rows) if direction % 2 == 0 else reversed(range(rows))


def _scan(volume: Tensor, weights: Tensor, direction: int) -> Tensor:
    """One of the four: A, from the volume (B, C, D, H, W) and the direction's weights (5, B, C, 1, H, W)."""
    volume, weights = _turned(volume, direction).contiguous(), _turned(weights, direction).contiguous()
    result, row = torch.empty_like(volume), None
    if volume.device.type == "meta":
        # what only counts memory and operations sees the volumes, not each row
        return _turned(result, direction)
    for y in _order(volume.shape[-2], direction):
        row = (
            _first(volume[..., y, :], weights[..., y, :])
            if row is None
            else (_next(row, volume[..., y, :], weights[..., y, :]))
        )
        result[..., y, :] = row
    return _turned(result, direction)


def _first(x: Tensor, w: Tensor) -> Tensor:
    """The first row of a path, (B, C, D, W): all that comes from a row before is missing."""
    return x * w.sum(0)


def _next(before: Tensor, x: Tensor, w: Tensor) -> Tensor:
    """A further row, from the one before."""
    padded = _with_ends(before, x)
    row = x * w[0]
    row = torch.addcmul(row, before, w[1])
    row = torch.addcmul(row, padded[:, :, :-2], w[2])
    row = torch.addcmul(row, padded[:, :, 2:], w[3])
    return torch.addcmul(row, before.amax(2, keepdim=True), w[4])


def _with_ends(before: Tensor, x: Tensor) -> Tensor:
    """The row before with a plane more at both ends, for which the pixel itself stands."""
    return torch.cat((x[:, :, :1], before, x[:, :, -1:]), dim=2)


def _scan_backward(
    volume: Tensor, weights: Tensor, direction: int, gradient: Tensor, to_volume: Tensor, to_weights: Tensor
) -> None:
    """Adds the gradient through one scan to that of the volume, and sets that of the weights."""
    scanned = _turned(_scan(volume, weights, direction), direction)
    volume, weights, gradient = (_turned(x, direction).contiguous() for x in (volume, weights, gradient))
    to_volume, to_weights = _turned(to_volume, direction), _turned(to_weights, direction)
    order = list(_order(volume.shape[-2], direction))
    arriving: Tensor | float = 0.0
    for y, previous in zip(reversed(order), [*reversed(order[:-1]), None], strict=True):
        x, w, g = volume[..., y, :], weights[..., y, :], gradient[..., y, :] + arriving
        if previous is None:
            to_volume[..., y, :] += g * w.sum(0)
            to_weights[..., y, :] = (g * x).sum(2, keepdim=True)
            return
        before = scanned[..., previous, :]
        padded = _with_ends(before, x)
        best, where = before.max(2, keepdim=True)
        total = g.sum(2, keepdim=True)
        terms = (x, before, padded[:, :, :-2], padded[:, :, 2:])
        to_weights[..., y, :] = torch.stack([*((g * term).sum(2, keepdim=True) for term in terms), total * best])
        # of the planes of `padded`: the first and the last are the pixel itself, the others the row before
        of_padded = F.pad(g * w[1], (0, 0, 1, 1))
        of_padded[:, :, :-2] += g * w[2]
        of_padded[:, :, 2:] += g * w[3]
        to_volume[..., y, :] += g * w[0]
        to_volume[:, :, 0, y, :] += of_padded[:, :, 0]
        to_volume[:, :, -1, y, :] += of_padded[:, :, -1]
        arriving = of_padded[:, :, 1:-1].scatter_add(2, where, total * w[4])


def _exported_scan(volume: Tensor, weights: Tensor, direction: int) -> Tensor:
    """`_scan` as one operation of a graph, whatever the number of rows."""
    from torch._higher_order_ops.scan import scan

    rows, of_rows = _turned(volume, direction).movedim(-2, 0), _turned(weights, direction).movedim(-2, 0)
    if direction % 2:
        rows, of_rows = rows.flip(0), of_rows.flip(0)

    def step(before: Tensor, row: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        result = _next(before, *row)
        return result, result.clone()

    first = _first(rows[0], of_rows[0])
    # copies: the tracer trips over views that are scanned
    _, others = scan(step, first, (rows[1:].clone(), of_rows[1:].clone()))
    result = torch.cat((first.unsqueeze(0), others))
    return _turned((result.flip(0) if direction % 2 else result).movedim(0, -2), direction)
