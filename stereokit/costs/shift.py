"""The two shifts that every cost volume is made of: multiply left by the shifted right one, or stack the right ones.

At level d, pixel x of the left map meets pixel x - d of the right map; where x < d there is none, and the result is 0.
"""

from typing import TypeAlias

import torch
from einops import rearrange
from torch import Tensor
from torch.nn import functional as F

from stereokit.errors import InputError
from stereokit.layers.warp import warp

__all__ = ["Planes", "check_features", "inner_products", "seen_from_left", "shifted_stack"]

Planes: TypeAlias = int | Tensor
"""The number of planes D, for the disparities 0 ... D - 1; or the disparities themselves, (B, D, H, W). In pixels of
the maps."""


def check_features(left: Tensor, right: Tensor, planes: Planes) -> None:
    """Raises `InputError` unless the maps are a pair, and the planes positive in number or candidates of each pixel."""
    if left.dim() != 4 or left.shape != right.shape:
        raise InputError(
            f"a cost volume wants two feature maps of one shape (B, C, H, W); "
            f"got {tuple(left.shape)} and {tuple(right.shape)}"
        )
    if isinstance(planes, Tensor):
        if planes.dim() != 4 or planes.shape[0] != left.shape[0] or planes.shape[-2:] != left.shape[-2:]:
            raise InputError(
                f"candidates are (B, D, H, W), of the size of the maps; got {tuple(planes.shape)} for maps "
                f"{tuple(left.shape)}"
            )
    elif planes < 1:
        raise InputError(f"a cost volume has at least 1 disparity plane; got planes={planes}")


def inner_products(left: Tensor, right: Tensor, planes: int) -> Tensor:
    r"""Inner products over channels, :math:`p(d, y, x) = \sum_c l_c(y, x)\, r_c(y, x - d)`.

    Each row is cut into tiles as wide as there are planes. A tile of the left row times the two tiles of the right row
    that it can reach is a small matrix product; the wanted products are a diagonal band of it.

    Args:
        left: (N, C, H, W).
        right: (N, C, H, W).
        planes: D.

    Returns:
        (N, D, H, W).

    >>> inner_products(torch.ones(1, 2, 1, 3), torch.ones(1, 2, 1, 3), 2)
    tensor([[[[2., 2., 2.]],
    <BLANKLINE>
             [[0., 2., 2.]]]])
    """
    width = left.shape[-1]
    tile = planes
    to_full_tiles = (width + tile - 1) // tile * tile - width
    reach = tile + planes - 1
    left_tiles = rearrange(F.pad(left, (0, to_full_tiles)), "n c h (t x) -> n h t x c", x=tile)
    right_tiles = F.pad(right, (planes - 1, to_full_tiles)).unfold(-1, reach, tile)
    products = left_tiles @ rearrange(right_tiles, "n c h t r -> n h t c r")
    # row x of a tile needs columns x ... x + planes - 1: one element more per row moves each row to the same columns
    rows = F.pad(products.flatten(-2), (0, tile))
    band = rearrange(rows, "n h t (x r) -> n h t x r", x=tile)[..., :planes]
    return rearrange(band.flip(-1), "n h t x d -> n d h (t x)")[..., :width]


def shifted_stack(right: Tensor, planes: int) -> Tensor:
    """The map shifted right by 0, 1, ..., planes - 1 pixels, zeros coming in: (B, C, H, W) to (B, C, D, H, W).

    >>> shifted_stack(torch.tensor([[[[1.0, 2.0, 3.0]]]]), 3).squeeze()
    tensor([[1., 2., 3.],
            [0., 1., 2.],
            [0., 0., 1.]])
    """
    width = right.shape[-1]
    padded = F.pad(right, (planes - 1, 0))
    return torch.stack([padded[..., s : s + width] for s in range(planes - 1, -1, -1)], dim=2)


def seen_from_left(right: Tensor, planes: Planes) -> tuple[Tensor, Tensor]:
    """The right map where each pixel of the left one would find its partner, and where there is one.

    Args:
        right: (B, C, H, W).
        planes: D, or candidates.

    Returns:
        (B, C, D, H, W), between pixels interpolated linearly; and a mask that broadcasts to it, 0 where the partner
        would lie left of the right map, else 1.

    >>> shifted, seen = seen_from_left(torch.tensor([[[[1.0, 2.0, 3.0]]]]), 2)
    >>> shifted.squeeze(), seen.squeeze()
    (tensor([[1., 2., 3.],
            [0., 1., 2.]]), tensor([[1., 1., 1.],
            [0., 1., 1.]]))
    """
    position = torch.arange(right.shape[-1], device=right.device)
    if isinstance(planes, Tensor):
        return warp(right, planes), (position >= planes).to(right.dtype).unsqueeze(1)
    level = torch.arange(planes, device=right.device)
    return shifted_stack(right, planes), (position >= level[:, None]).to(right.dtype)[:, None]
