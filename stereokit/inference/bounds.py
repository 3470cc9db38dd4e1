"""Pairs matched within a limit of memory."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Literal, TypeAlias, get_args

import torch
from torch import Tensor, nn

from stereokit.contracts import StereoOutput
from stereokit.errors import ConfigError, InputError
from stereokit.inference.scaling import Run, match_scaled
from stereokit.inference.tiles import OVERLAP, match_tiles, tile_grid
from stereokit.network import MIN_SIZE
from stereokit.runtime.memory import (
    MemorySize,
    available_memory,
    estimate_memory,
    format_memory,
    hand_back_memory,
    parse_memory,
    running_out_as,
)

__all__ = ["BoundedMatcher", "MemoryPlan", "TooLarge"]

TooLarge: TypeAlias = Literal["error", "tile", "reduce"]
"""What becomes of a pair that does not fit: it is refused, matched in tiles, or matched at a reduced resolution."""


MOST_TILES = 256
"""In each direction."""


@dataclass(frozen=True)
class MemoryPlan:
    """How a pair is to be matched within the memory that is allowed.

    Args:
        how: whole, in tiles, or at a reduced resolution.
        needed: bytes at most, for the whole pair, as `estimate_memory` has them; None where there is no limit.
        allowed: bytes; None where there is no limit.
        tile: height and width of the tiles.
        tiles: how many of them.
        scale: of the reduced resolution, see `match_scaled`.
    """

    how: Literal["whole", "tile", "reduce"]
    needed: int | None
    allowed: int | None
    tile: tuple[int, int] | None = None
    tiles: int = 1
    scale: float | None = None


class BoundedMatcher:
    """Runs a network within a limit of memory, which is checked before it starts.

    Args:
        network: in eval mode, on its device; its memory is estimated. Tiles need its `max_disparity`, the columns that
            they share, and begin at multiples of its `multiple`, 1 if it has none.
        run: what runs it, such as its compiled form; the network itself by default. Takes images on the network's
            device.
        max_memory: bytes, or a text such as "4GiB", that a pass may take beside the weights; by default what is free
            on the network's device when a pair comes.
        too_large: what becomes of a pair that needs more: "error" says so, and what to do; "tile", see
            `match_tiles`; "reduce", see `match_scaled`.
        overlap: of the tiles, in pixels.
        estimate: height and width to bytes, in place of `estimate_memory` of the network.
        device: whose free memory counts, in place of the network's.

    Raises:
        ConfigError: an unknown `too_large`, no amount of memory, or tiles of a network without `max_disparity`.

    >>> from stereokit import build_model
    >>> model = build_model("coex", max_disparity=32).eval()
    >>> match = BoundedMatcher(model, max_memory="100MB", too_large="tile")
    >>> match.plan(2000, 3000).how
    'tile'
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        run: Run | None = None,
        max_memory: MemorySize | None = None,
        too_large: TooLarge = "error",
        overlap: int = OVERLAP,
        estimate: Callable[[int, int], int] | None = None,
        device: torch.device | None = None,
    ) -> None:
        if too_large not in get_args(TooLarge):
            raise ConfigError(f"too_large={too_large!r} is unknown; use 'error', 'tile' or 'reduce'")
        self.max_memory = None if max_memory is None else parse_memory(max_memory)
        self.too_large: TooLarge = too_large
        self.overlap = overlap
        self.run: Run = network if run is None else run
        self._images_on = next((tensor.device for tensor in (*network.parameters(), *network.buffers())), None)
        self.device = device or self._images_on
        ceiling = getattr(network, "max_disparity", None)
        if ceiling is None and too_large == "tile":
            raise ConfigError(
                f"tiles share as many columns as the largest disparity, and {type(network).__name__} has no attribute "
                "max_disparity that tells it; set it, or use 'reduce'"
            )
        self._cuts = ceiling is not None
        self.max_disparity = int(ceiling or 0)
        self.multiple = int(getattr(network, "multiple", 1))
        self._estimate = partial(estimate_memory, network) if estimate is None else estimate
        self._known: dict[tuple[int, int], int] = {}

    def __call__(self, left: Tensor, right: Tensor) -> StereoOutput:
        """Matches a pair of one or more images (B, 3, H, W); the limit is for each of the B.

        Raises:
            InputError: the pair does not fit, and is not to be cut or reduced, or can't be.
        """
        return self.match(left, right, self.plan(*left.shape[-2:]))

    def match(self, left: Tensor, right: Tensor, plan: MemoryPlan, *, run: Run | None = None) -> StereoOutput:
        """Matches a pair as `plan` has found for its size.

        Args:
            left: (B, 3, H, W).
            right: likewise.
            plan: for their size.
            run: what runs the network for this pair, in place of the usual one.

        Raises:
            InputError: it takes more memory than was estimated.
        """
        height, width = left.shape[-2:]
        on_device = partial(self._on_device, run or self.run)
        # the estimate is for a pass that keeps nothing for gradients
        with (
            torch.no_grad(),
            running_out_as(
                f"a pair of {width} x {height} pixels took more memory of {self.device or left.device} than was "
                "estimated; use a smaller max_memory with 'tile' or 'reduce'"
            ),
        ):
            if plan.how == "tile" and plan.tile is not None:
                return match_tiles(
                    on_device,
                    left,
                    right,
                    tile=plan.tile,
                    max_disparity=self.max_disparity,
                    overlap=self.overlap,
                    multiple=self.multiple,
                )
            if plan.how == "reduce" and plan.scale is not None:
                return match_scaled(on_device, left, right, scale=plan.scale)
            return on_device(left, right)

    def plan(self, height: int, width: int) -> MemoryPlan:
        """How a pair of this size is matched.

        Raises:
            InputError: it does not fit, and is not to be cut or reduced, or can't be; the message says what to use.
        """
        allowed = self.max_memory if self.max_memory is not None else available_memory(self.device or "cpu")
        if allowed is None:
            return MemoryPlan("whole", None, None)
        # other threads may add sizes
        larger = (needed for (h, w), needed in list(self._known.items()) if height <= h and width <= w)
        if (bound := min(larger, default=None)) is not None and bound <= allowed:
            return MemoryPlan("whole", bound, allowed)
        needed = self._needed(height, width)
        if needed > allowed and self.max_memory is None:
            # what this process keeps of freed tensors counts as taken
            hand_back_memory()
            allowed = available_memory(self.device or "cpu") or allowed
        if needed <= allowed:
            return MemoryPlan("whole", needed, allowed)
        # what was not asked for is looked for too where it can be offered
        tile = self._tile(height, width, allowed) if self.too_large != "reduce" else None
        scale = self._scale(height, width, allowed) if tile is None or self.too_large == "error" else None
        if self.too_large == "reduce" and scale is None:
            tile = self._tile(height, width, allowed)
        if self.too_large == "tile" and tile is not None:
            return MemoryPlan("tile", needed, allowed, tile=tile, tiles=self._count(height, width, tile))
        if self.too_large == "reduce" and scale is not None:
            return MemoryPlan("reduce", needed, allowed, scale=scale)
        raise InputError(self._refusal(height, width, needed, allowed, tile, scale))

    def _on_device(self, run: Run, left: Tensor, right: Tensor) -> StereoOutput:
        device = self._images_on or left.device
        return run(left.to(device), right.to(device))

    def _needed(self, height: int, width: int) -> int:
        if (height, width) not in self._known:
            self._known[height, width] = self._estimate(height, width)
        return self._known[height, width]

    def _count(self, height: int, width: int, tile: tuple[int, int]) -> int:
        rows, columns = tile_grid(
            (height, width), tile, max_disparity=self.max_disparity, overlap=self.overlap, multiple=self.multiple
        )
        return len(rows) * len(columns)

    def _tile(self, height: int, width: int, allowed: int) -> tuple[int, int] | None:
        """The tiles that fit and have the fewest pixels in all; None where none fits."""
        if not self._cuts:
            return None
        pixels = height * width * allowed / self._needed(height, width)
        for _ in range(8):
            tile = self._cheapest_tile(height, width, pixels)
            if tile is None:
                return None
            needed = self._needed(*tile)
            if needed <= allowed:
                return tile
            # memory does not grow exactly with the pixels
            pixels = tile[0] * tile[1] * allowed / needed * 0.98
        return None

    def _cheapest_tile(self, height: int, width: int, pixels: float) -> tuple[int, int] | None:
        shared = (self.overlap, self.max_disparity + self.overlap)
        heights, widths = (
            [(count, self._tile_side(length, count, common)) for count in range(1, MOST_TILES + 1)]
            for length, common in zip((height, width), shared, strict=True)
        )
        fitting = [
            (rows * columns * h * w, rows * columns, (h, w))
            for (rows, h), (columns, w) in product(heights, widths)
            if h is not None and w is not None and h * w <= pixels
        ]
        return min(fitting)[-1] if fitting else None

    def _tile_side(self, length: int, count: int, shared: int) -> int | None:
        """The side of `count` tiles over a length; None where fewer do with the same side."""
        if count == 1:
            return length
        step = -(-(length - shared) // count)
        step = -(-step // self.multiple) * self.multiple
        side = shared + step
        return None if step < self.multiple or side >= length else max(side, MIN_SIZE + self.multiple)

    def _scale(self, height: int, width: int, allowed: int) -> float | None:
        """The largest resolution that fits; None where none does."""
        scale: float = (allowed / self._needed(height, width)) ** 0.5
        while scale * min(height, width) >= MIN_SIZE:
            # two digits, so that a user can repeat it
            scale = int(scale * 100) / 100
            if scale <= 0:
                return None
            small = (round(height * scale), round(width * scale))
            if min(small) >= MIN_SIZE and self._needed(*small) <= allowed:
                return scale
            scale *= 0.95
        return None

    def _refusal(
        self, height: int, width: int, needed: int, allowed: int, tile: tuple[int, int] | None, scale: float | None
    ) -> str:
        whose = f"free on {self.device or 'cpu'}" if self.max_memory is None else "allowed by max_memory"
        offers = []
        if tile is not None:
            count = self._count(height, width, tile)
            offers.append(
                f"too_large='tile' (--too-large tile) would match it in {count} overlapping tiles of {tile[1]} x "
                f"{tile[0]} pixels{self._reach(1)}"
            )
        if scale is not None:
            offers.append(
                f"too_large='reduce' (--too-large reduce) would match it at {scale:g} of its size{self._reach(scale)}"
            )
        if not offers:
            least = min(1.0, -(-100 * MIN_SIZE // min(height, width)) / 100)
            smallest = self._needed(round(height * least), round(width * least))
            offers.append(
                "neither a tile nor a reduced resolution fits: even at "
                f"{least:g} of its size it needs about {format_memory(smallest)}"
            )
        return (
            f"a pair of {width} x {height} pixels needs about {format_memory(needed)} of memory, "
            f"{format_memory(allowed)} are {whose}; {', '.join(offers)}"
        )

    def _reach(self, scale: float) -> str:
        return f", with disparities up to {self.max_disparity / scale:.0f} px" if self.max_disparity else ""
