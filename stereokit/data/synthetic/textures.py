"""What surfaces look like: tiles and photographs, coloured and fixed to the surface's own coordinates."""

import colorsys
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.data.datasets.layout import images_in
from stereokit.data.images import read_image, to_uint8
from stereokit.data.synthetic.patterns import TILE, draw_tiles
from stereokit.data.synthetic.surfaces import Array
from stereokit.errors import ConfigError, InputError

__all__ = ["Ground", "Texture", "TextureBank", "random_palette"]

Image: TypeAlias = npt.NDArray[np.uint8]
Pyramid: TypeAlias = tuple[Image, ...]

_LEVELS = 7
_LARGEST_PHOTOGRAPH = 1024
_FARTHEST = 0.25  # disparity below which a ground's texture gets no smaller
_HELD_PHOTOGRAPHS = 64  # of up to 4 MB each, in each process


@dataclass(frozen=True)
class Ground:
    """Perspective of a texture on a plane that runs away from the camera, as a floor does.

    At disparity d the place on the plane is (u - u0, reach) * near / d.

    Attributes:
        near: disparity of the row where the texture is as large as on a board.
        column: u0.
        horizon: row where disparity would be 0.
        reach: rows from the horizon to where disparity is `near`.
    """

    near: float
    column: float
    horizon: float
    reach: float


@dataclass(frozen=True, eq=False)
class Texture:
    """Colours as a function of the place on a surface, the same from both views.

    Attributes:
        image: from fine to coarse, each half the size of the one before. One channel repeats without a seam; three are
            a photograph, which is mirrored beyond its border.
        palette: (256, 3): the colour of each grey, or of each channel's value.
        turn: in radians, of the texture on the surface.
        texels: of the finest level per pixel.
        origin: texel at the origin of the view.
        modulation: another one-channel image, how many of its texels are on one of the first, and its weight.
        ground: perspective, where the surface has it.
    """

    image: Pyramid
    palette: Image
    turn: float
    texels: float
    origin: tuple[float, float]
    modulation: tuple[Pyramid, float, float] | None = None
    ground: Ground | None = None

    def colours(self, u: Array, v: Array, disparity: Array) -> Image:
        """The colours (rows, columns, 3) at columns u (rows, columns) and rows v (rows, 1) of the left view."""
        if self.ground is None:
            return self._colours(u, v, math.log2(self.texels))
        depth = np.float32(self.ground.near) / np.maximum(disparity, np.float32(_FARTHEST))
        x, z = (u - np.float32(self.ground.column)) * depth, np.float32(self.ground.reach) * depth
        levels = _levels_of_rows(self.ground, self.texels, v)
        bands = np.flatnonzero(np.diff(levels, prepend=-1, append=-1))
        result = np.empty((*u.shape, 3), np.uint8)
        for first, last in pairwise(bands):
            result[first:last] = self._colours(x[first:last], z[first:last], float(levels[first]))
        return result

    def _colours(self, x: Array, y: Array, level: float) -> Image:
        scale = self.texels
        cosine, sine = scale * math.cos(self.turn), scale * math.sin(self.turn)
        s = np.float32(cosine) * x
        s += np.float32(sine) * y + np.float32(self.origin[0])
        t = np.float32(-sine) * x
        t += np.float32(cosine) * y + np.float32(self.origin[1])
        values = _sample(self.image, s, t, level)
        if self.modulation is not None:
            image, ratio, weight = self.modulation
            other = _sample(image, s * np.float32(ratio), t * np.float32(ratio), level + math.log2(ratio))
            values = np.asarray(cv2.addWeighted(values, 1 - weight, other, weight, 0), np.uint8)
        if values.ndim == 2:
            return np.asarray(cv2.applyColorMap(values, self.palette[:, None]), np.uint8)
        return np.asarray(cv2.LUT(values, self.palette[None]), np.uint8)


def _levels_of_rows(ground: Ground, texels: float, v: Array) -> npt.NDArray[np.int64]:
    """The level for each row of a ground. It hangs on the row alone, so that both views have the same one."""
    depth = ground.reach / np.maximum(v[:, 0] - ground.horizon, 1.0)
    depth = np.minimum(depth, ground.near / _FARTHEST)
    # a pixel covers `depth` texels across and `depth` squared along the ground
    return np.clip(np.rint(np.log2(texels * depth**1.5)), 0, _LEVELS - 1).astype(np.int64)


def _sample(pyramid: Pyramid, s: Array, t: Array, level: float) -> Image:
    number = min(max(round(level), 0), len(pyramid) - 1)
    if number:
        part, shift = np.float32(0.5**number), np.float32(0.5 * 0.5**number - 0.5)
        s, t = s * part + shift, t * part + shift
    image = pyramid[number]
    # far quicker than to let remap find its way back from beyond the border
    height, width = image.shape[:2]
    if image.ndim == 2:
        s, t, border = _repeated(s, width), _repeated(t, height), cv2.BORDER_WRAP
    else:
        s, t, border = _mirrored(s, width), _mirrored(t, height), cv2.BORDER_REPLICATE
    return np.asarray(cv2.remap(image, s, t, cv2.INTER_LINEAR, borderMode=border), np.uint8)


def _repeated(place: Array, size: int) -> Array:
    whole = np.floor(place * np.float32(1 / size))
    whole *= np.float32(-size)
    whole += place
    return whole


def _mirrored(place: Array, size: int) -> Array:
    place = _repeated(place + np.float32(0.5), 2 * size)
    mirrored: Array = np.minimum(place, np.float32(2 * size) - place) - np.float32(0.5)
    return mirrored


class TextureBank:
    """Tiles drawn once, and photographs, from which scenes take crops in new colours.

    Of the photographs those used last are held in memory.

    Args:
        seed: of the tiles.
        tiles: how many.
        plain: factor on how often a texture has next to no contrast.
        photographs: a folder of images to use as well.

    Raises:
        ConfigError: the factor is negative.
        InputError: the folder holds no image, or one that can't be read.
    """

    def __init__(self, seed: int, *, tiles: int = 48, plain: float = 1.0, photographs: Path | None = None) -> None:
        if not plain >= 0:
            raise ConfigError(f"plain must be at least 0, got {plain}")
        self.plain = plain
        self.tiles = _tiles(seed, tiles)
        self.photographs: list[Path] = [] if photographs is None else _find_photographs(photographs)

    def texture(
        self,
        rng: np.random.Generator,
        *,
        contrast: tuple[float, float] = (0.3, 1.0),
        plain: float = 0.15,
        ground: Ground | None = None,
    ) -> Texture:
        """A random texture.

        Args:
            rng: source of randomness.
            contrast: range of it, where the texture is not plain.
            plain: probability of next to no contrast.
            ground: perspective, for a floor.
        """
        is_photograph = bool(self.photographs) and rng.random() < 0.5
        strength = (
            math.exp(rng.uniform(math.log(0.01), math.log(0.15)))
            if rng.random() < self.plain * plain
            else rng.uniform(*contrast)
        )
        texels = math.exp(rng.uniform(math.log(0.4), math.log(3.0)))
        modulation = None
        if is_photograph:
            image = _photograph(self.photographs[rng.integers(len(self.photographs))])
            palette = _random_tone_curves(rng, strength)
        else:
            image = self.tiles[rng.integers(len(self.tiles))]
            palette = random_palette(rng, strength)
            if rng.random() < 0.5:
                ratio = math.exp(rng.uniform(math.log(0.08), math.log(2.0)))
                modulation = (self.tiles[rng.integers(len(self.tiles))], ratio, rng.uniform(0.15, 0.6))
        turn = rng.uniform(-math.pi, math.pi) if rng.random() < 0.4 else rng.integers(4) * math.pi / 2
        origin = float(rng.uniform(0, TILE)), float(rng.uniform(0, TILE))
        return Texture(image, palette, float(turn), texels, origin, modulation, ground)

    def sky(self, rng: np.random.Generator) -> Texture:
        """Soft, bright and of little contrast; often of none."""
        tile = self.tiles[rng.integers(len(self.tiles))]
        top = np.array(colorsys.hsv_to_rgb(rng.uniform(0.52, 0.65), rng.beta(1.2, 2.5), rng.uniform(0.45, 1.0)))
        haze = np.clip(top + rng.uniform(0.0, 0.4), 0, 1)
        strength = rng.choice((0.0, rng.uniform(0.02, 0.2), rng.uniform(0.2, 1.0)), p=(0.3, 0.35, 0.35))
        palette = _blend([haze, haze + strength * (top - haze)], np.array([0.0, 1.0]))
        return _laid(rng, tile, palette, texels=0.15)

    def shade(self, rng: np.random.Generator) -> Texture:
        """Brightness, in greys: it changes slowly, as on a bent surface, or at once, as at the edge of a shadow."""
        tile = self.tiles[rng.integers(len(self.tiles))]
        dark = rng.uniform(0.25, 0.85)
        half = 0.5 if rng.random() < 0.5 else math.exp(rng.uniform(math.log(0.02), math.log(0.2)))
        middle = rng.uniform(half, 1 - half)
        brightness = np.interp(np.linspace(0, 1, 256), (middle - half, middle + half), (dark, 1.0))
        palette = to_uint8(np.repeat(brightness[:, None], 3, axis=1))
        return _laid(rng, tile, palette, texels=math.exp(rng.uniform(math.log(0.1), math.log(1.0))))


def _laid(rng: np.random.Generator, tile: Pyramid, palette: Image, *, texels: float) -> Texture:
    turn = float(rng.uniform(0, math.pi))
    return Texture(tile, palette, turn, texels, (float(rng.uniform(0, TILE)), float(rng.uniform(0, TILE))))


def random_palette(rng: np.random.Generator, contrast: float) -> Image:
    """Colours for the greys of a tile, (256, 3): two to five of them, and all between.

    Args:
        rng: source of randomness.
        contrast: 0 for one colour, 1 for all that was drawn.
    """
    count = int(rng.integers(2, 6))
    base, vivid = rng.uniform(), rng.beta(1.2, 2.5)
    colours = []
    for _ in range(count):
        hue = base + 0.06 * rng.standard_normal() if rng.random() < 0.75 else rng.uniform()
        colours.append(
            np.array(colorsys.hsv_to_rgb(hue % 1.0, min(vivid * rng.uniform(0.4, 1.6), 1.0), rng.uniform(0.04, 1.0)))
        )
    # two places never so close that a smooth tile would get a jagged edge
    places = np.cumsum([0.0, *rng.uniform(0.5, 1.5, count - 1)])
    mean = np.mean(colours, axis=0)
    return _blend([mean + contrast * (colour - mean) for colour in colours], places / places[-1])


def _random_tone_curves(rng: np.random.Generator, contrast: float) -> Image:
    values = np.linspace(0, 1, 256)[:, None] ** rng.uniform(0.6, 1.6, 3 if rng.random() < 0.5 else 1)
    if rng.random() < 0.1:
        values = 1 - values
    gain, middle = rng.uniform(0.7, 1.2, 3), rng.uniform(0.2, 0.7)
    curves = gain * np.broadcast_to(middle + contrast * (values - middle), (256, 3))
    return to_uint8(curves)


def _blend(colours: Sequence[npt.NDArray[Any]], places: npt.NDArray[Any]) -> Image:
    at, table = np.linspace(0, 1, 256), np.array(colours)
    palette = np.stack([np.interp(at, places, table[:, channel]) for channel in range(3)], axis=1)
    return to_uint8(palette)


@lru_cache(maxsize=2)
def _tiles(seed: int, count: int) -> tuple[Pyramid, ...]:
    """The tiles of a seed, which are drawn for some seconds and then shared by all that use them."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    return tuple(_pyramid(tile) for tile in draw_tiles(rng, count))


def _pyramid(image: Image) -> Pyramid:
    levels = [image]
    while len(levels) < _LEVELS and min(levels[-1].shape[:2]) >= 16:
        height, width = levels[-1].shape[:2]
        half = cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(half, np.uint8))
    return tuple(levels)


def _find_photographs(folder: Path) -> list[Path]:
    paths = images_in(folder)
    if not paths:
        raise InputError(f"no images to use as textures in {str(folder)!r}; expected a folder of PNG or JPEG files")
    for path in paths:
        # one that can't be read is found now rather than in the middle of a run
        read_image(path)
    return paths


@lru_cache(maxsize=_HELD_PHOTOGRAPHS)
def _photograph(path: Path) -> Pyramid:
    image = to_uint8(read_image(path))
    height, width = image.shape[:2]
    shrink = min(1.0, _LARGEST_PHOTOGRAPH / max(height, width))
    if shrink < 1:
        size = max(round(width * shrink), 1), max(round(height * shrink), 1)
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    return _pyramid(np.ascontiguousarray(image))
