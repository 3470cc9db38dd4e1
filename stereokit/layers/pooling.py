"""Means over windows of any size, as products with a matrix for each axis."""

import torch
from torch import Tensor

from stereokit.errors import InputError

__all__ = ["cell_means", "tent_means"]


def _means(x: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Maps (B, C, H, W) by weights (h, H) and (w, W) whose rows are divided by their sums: (B, C, h, w)."""
    rows, columns = (weights / weights.sum(1, keepdim=True) for weights in (rows, columns))
    return rows.to(x.dtype) @ x @ columns.to(x.dtype).T


def tent_means(x: Tensor, height: int, width: int) -> Tensor:
    r"""Smaller maps, each pixel a mean of those around it that falls off linearly.

    .. math:: y_{ij} = \frac{\sum_{kl} t(k - is) t(l - js') x_{kl}}{\sum_{kl} t(k - is) t(l - js')}, \quad
        t(u) = \max(0, 1 - |u| / s), \quad s = \frac{H - 1}{h - 1}, \quad s' = \frac{W - 1}{w - 1}

    so that the corners of both maps lie on each other.

    Args:
        x: (B, C, H, W).
        height: h of the output, from 2 to H.
        width: w of the output, from 2 to W.

    Returns:
        (B, C, h, w).

    Raises:
        InputError: a size that is larger than that of the maps, or below 2.

    Source: the "Downsample" layer of Caffe by which Pang et al., "Cascade residual learning", ICCV workshops 2017,
    bring a disparity to coarser scales.

    >>> tent_means(torch.tensor([[0.0, 1.0, 2.0, 3.0, 4.0]]).expand(1, 1, 3, 5), 2, 3)[0, 0, 0]
    tensor([0.3333, 2.0000, 3.6667])
    """
    for given, wanted in ((x.shape[-2], height), (x.shape[-1], width)):
        if not 2 <= wanted <= given:
            raise InputError(f"tent_means gives sides from 2 to those of the maps, {tuple(x.shape[-2:])}; got {wanted}")

    def tents(given: int, wanted: int) -> Tensor:
        here, there = (torch.arange(n, device=x.device).to(torch.float32) for n in (given, wanted))
        # a tensor, and no number, which ONNX has no product with where the size is open
        step = here[-1:] / there[-1:]
        return (1 - (here - step * there.unsqueeze(1)).abs() / step).clamp(min=0.0)

    return _means(x, tents(x.shape[-2], height), tents(x.shape[-1], width))


def cell_means(x: Tensor, cells: int) -> Tensor:
    r"""The means of `cells` x `cells` windows that cover the maps: `adaptive_avg_pool2d`.

    Window i reaches from floor(i H / cells) to ceil((i + 1) H / cells). As products of matrices it is exported with an
    open size too.

    Args:
        x: (B, C, H, W).
        cells: windows on a side.

    Returns:
        (B, C, cells, cells).

    >>> cell_means(torch.arange(4.0).expand(1, 1, 2, 4), 2)[0, 0]
    tensor([[0.5000, 2.5000],
            [0.5000, 2.5000]])
    """

    def windows(given: int) -> Tensor:
        cell = torch.arange(cells, device=x.device).unsqueeze(1)
        first, end = cell * given // cells, ((cell + 1) * given + cells - 1) // cells
        at = torch.arange(given, device=x.device)
        return ((at >= first) & (at < end)).to(torch.float32)

    return _means(x, windows(x.shape[-2]), windows(x.shape[-1]))
