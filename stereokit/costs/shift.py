"""The two shifts that every cost volume is made of: multiply left by the shifted right one, or stack the right ones.

At level d, pixel x of the left map meets pixel x - d of the right map; where x < d there is none, and the result is 0.
"""

import torch
from einops import rearrange
from torch import Tensor
from torch.nn import functional as F

from stereokit.errors import InputError

__all__ = ["check_features", "inner_products", "shifted_stack"]


def check_features(left: Tensor, right: Tensor, levels: int) -> None:
    """Raises `InputError` unless the maps are a pair and the number of levels is positive."""
    if left.dim() != 4 or left.shape != right.shape:
        raise InputError(
            f"a cost volume wants two feature maps of one shape (B, C, H, W); "
            f"got {tuple(left.shape)} and {tuple(right.shape)}"
        )
    if levels < 1:
        raise InputError(f"a cost volume has at least 1 disparity level; got levels={levels}")


def inner_products(left: Tensor, right: Tensor, levels: int) -> Tensor:
    r"""Inner products over channels, :math:`p(d, y, x) = \sum_c l_c(y, x)\, r_c(y, x - d)`.

    Each row is cut into tiles as wide as there are levels. A tile of the left row times the two tiles of the right row
    that it can reach is a small matrix product; the wanted products are a diagonal band of it.

    Args:
        left: (N, C, H, W).
        right: (N, C, H, W).
        levels: D.

    Returns:
        (N, D, H, W).

    >>> inner_products(torch.ones(1, 2, 1, 3), torch.ones(1, 2, 1, 3), 2)
    tensor([[[[2., 2., 2.]],
    <BLANKLINE>
             [[0., 2., 2.]]]])
    """
    width = left.shape[-1]
    tile = levels
    to_full_tiles = (width + tile - 1) // tile * tile - width
    reach = tile + levels - 1
    left_tiles = rearrange(F.pad(left, (0, to_full_tiles)), "n c h (t x) -> n h t x c", x=tile)
    right_tiles = F.pad(right, (levels - 1, to_full_tiles)).unfold(-1, reach, tile)
    products = left_tiles @ rearrange(right_tiles, "n c h t r -> n h t c r")
    # row x of a tile needs columns x .. x + levels - 1: one element more per row moves each row to the same columns
    rows = F.pad(products.flatten(-2), (0, tile))
    band = rearrange(rows, "n h t (x r) -> n h t x r", x=tile)[..., :levels]
    return rearrange(band.flip(-1), "n h t x d -> n d h (t x)")[..., :width]


def shifted_stack(right: Tensor, levels: int) -> Tensor:
    """The map shifted right by 0, 1, .., levels - 1 pixels, zeros coming in: (B, C, H, W) to (B, C, D, H, W).

    >>> shifted_stack(torch.tensor([[[[1.0, 2.0, 3.0]]]]), 3).squeeze()
    tensor([[1., 2., 3.],
            [0., 1., 2.],
            [0., 0., 1.]])
    """
    width = right.shape[-1]
    padded = F.pad(right, (levels - 1, 0))
    return torch.stack([padded[..., s : s + width] for s in range(levels - 1, -1, -1)], dim=2)
