"""Procedural patterns: square grey tiles that repeat without a seam, drawn once and coloured when used."""

import math
import string
from collections.abc import Callable
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.data.images import to_uint8
from stereokit.data.synthetic.surfaces import Array

__all__ = ["PATTERNS", "TILE", "Tile", "draw_tiles", "noise"]

TILE = 512
"""Side of a tile in texels."""

Tile: TypeAlias = npt.NDArray[np.uint8]
Generator: TypeAlias = np.random.Generator

_FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_SCRIPT_COMPLEX, cv2.FONT_HERSHEY_DUPLEX)
# where to draw a mark on a canvas of twice the size so that the tile repeats
_COPIES = [(dx, dy) for dx in (-2 * TILE, 0, 2 * TILE) for dy in (-2 * TILE, 0, 2 * TILE)]
_LETTERS = string.ascii_letters + string.digits + "&%?!"


def noise(rng: Generator, *, exponent: float, longest: float = TILE, stretch: float = 1.0) -> Array:
    """Noise whose amplitude falls with frequency f as (f^2 + f0^2)^(-exponent / 2), about 0 with variance 1.

    Args:
        rng: source of randomness.
        exponent: 0 is white, 1 like natural images, 2 and more soft.
        longest: 1 / f0 in texels.
        stretch: of one direction, for grain.

    Returns:
        (TILE, TILE). Frequencies that a tile could not hold without aliasing are left out.
    """
    down = np.fft.fftfreq(TILE)[:, None] * stretch
    across = np.fft.rfftfreq(TILE)[None]
    squared = down**2 + across**2
    gain = (squared + longest**-2.0) ** (-exponent / 2) * np.exp(-((squared / stretch**2 / 0.3**2) ** 2))
    gain[0, 0] = 0
    field: Array = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((TILE, TILE))) * gain, (TILE, TILE)).astype(
        np.float32
    )
    return field / field.std()


def draw_tiles(rng: Generator, count: int) -> list[Tile]:
    """`count` tiles, the kinds of pattern taking turns."""
    kinds = list(PATTERNS.values())
    return [_as_tile(kinds[number % len(kinds)](rng)) for number in range(count)]


def _as_tile(values: Array) -> Tile:
    low, high = np.quantile(values, (0.005, 0.995))
    tile: Tile = to_uint8((values - low) / max(high - low, 1e-6))
    return tile


def _multi_octave(rng: Generator) -> Array:
    return noise(rng, exponent=rng.uniform(0.9, 1.8), longest=math.exp(rng.uniform(3, 6)))


def _speckle(rng: Generator) -> Array:
    return noise(rng, exponent=rng.uniform(0.0, 0.7))


def _ridges(rng: Generator) -> Array:
    ridges: Array = -np.abs(noise(rng, exponent=rng.uniform(1.6, 2.2), longest=rng.uniform(60, 200)))
    return ridges + 0.15 * noise(rng, exponent=1.0)


def _grain(rng: Generator) -> Array:
    field = noise(rng, exponent=rng.uniform(1.0, 1.8), stretch=rng.uniform(6, 20))
    return field if rng.random() < 0.5 else np.ascontiguousarray(field.T)


def _soft(rng: Generator) -> Array:
    return noise(rng, exponent=4.0, longest=rng.uniform(150, 400))


def _stripes(rng: Generator) -> Array:
    axis = np.arange(TILE, dtype=np.float32) * np.float32(2 * math.pi / TILE)
    across, down = int(rng.integers(0, 48)), int(rng.integers(-24, 25))
    phase = (across or 16) * axis[None] + down * axis[:, None]
    phase = phase + rng.uniform(0, 2.5) * noise(rng, exponent=3.0, longest=200)
    stripes: Array = np.tanh(rng.uniform(0.5, 5) * np.sin(phase))
    return stripes + rng.uniform(0.02, 0.4) * noise(rng, exponent=1.2)


def _checkers(rng: Generator) -> Array:
    return _tiled(rng, rows=int(2 ** rng.integers(2, 6)), columns=int(2 ** rng.integers(2, 6)), joint=0, shift=False)


def _bricks(rng: Generator) -> Array:
    rows = int(2 ** rng.integers(3, 6))
    return _tiled(rng, rows=rows, columns=rows // 2, joint=int(rng.integers(3, 9)), shift=True)


def _tiled(rng: Generator, *, rows: int, columns: int, joint: int, shift: bool) -> Array:
    side = 2 * TILE
    y, x = np.mgrid[:side, :side]
    row = y * rows // side
    x = (x + (row % 2) * (side // columns // 2 if shift else 0)) % side
    column = x * columns // side
    tones = rng.uniform(0, rng.uniform(0.2, 1), (rows, columns)).astype(np.float32)
    if not shift:
        tones += np.indices((rows, columns)).sum(axis=0) % 2
    field = tones[row, column] + 0.5
    if joint:
        field[(x % (side // columns) < joint) | (y % (side // rows) < joint)] = rng.choice((0.0, 1.6))
    return _halved(field) + rng.uniform(0.02, 0.25) * noise(rng, exponent=1.2)


def _dots(rng: Generator) -> Array:
    canvas = np.full((2 * TILE, 2 * TILE), 128, np.uint8)
    largest = math.exp(rng.uniform(2.0, 4.2))
    for _ in range(int(min(6e5 / largest**2, 1500))):
        x, y = map(int, rng.integers(0, 2 * TILE, 2))
        radius = max(3, int(largest * rng.beta(1.5, 3) * 1.6))
        shade, thickness = int(rng.integers(256)), -1 if rng.random() < 0.8 else 3
        for dx, dy in _COPIES:
            cv2.circle(canvas, (x + dx, y + dy), radius, shade, thickness, cv2.LINE_AA)
    return _halved(canvas) / 60 + rng.uniform(0.0, 0.3) * noise(rng, exponent=1.0)


def _strokes(rng: Generator) -> Array:
    canvas = np.full((2 * TILE, 2 * TILE), 128, np.uint8)
    turn, spread = rng.uniform(0, math.pi), rng.uniform(0.05, 2)
    for _ in range(int(rng.integers(150, 700))):
        x, y = map(int, rng.integers(0, 2 * TILE, 2))
        angle, length = turn + spread * rng.standard_normal(), math.exp(rng.uniform(2.5, 5.5))
        end = int(x + length * math.cos(angle)), int(y + length * math.sin(angle))
        shade, width = int(rng.integers(256)), int(rng.integers(2, 9))
        for dx, dy in _COPIES:
            cv2.line(canvas, (x + dx, y + dy), (end[0] + dx, end[1] + dy), shade, width, cv2.LINE_AA)
    return _halved(canvas) / 60 + rng.uniform(0.0, 0.3) * noise(rng, exponent=1.0)


def _text(rng: Generator) -> Array:
    """Lines of marks like print."""
    canvas = np.full((2 * TILE, 2 * TILE), 235, np.uint8)
    lines = int(2 ** rng.integers(3, 6))
    height = 2 * TILE / lines
    font, ink = int(rng.choice(_FONTS)), int(rng.integers(0, 120))
    for line in range(lines):
        if rng.random() < 0.15:
            continue
        x = int(rng.integers(0, TILE))
        for _ in range(int(rng.integers(2, 12))):
            word = "".join(rng.choice(list(_LETTERS), int(rng.integers(1, 9))))
            size, y = height / 42, int((line + 0.75) * height)
            (width, _), _ = cv2.getTextSize(word, font, size, 2)
            thickness = max(2, int(height / 20))
            for dx, dy in _COPIES:
                cv2.putText(canvas, word, (x + dx, y + dy), font, size, ink, thickness, cv2.LINE_AA)
            x += width + int(height / 2)
            if x > 2 * TILE:
                break
    return _halved(canvas) / 80 + rng.uniform(0.0, 0.2) * noise(rng, exponent=1.4)


def _cells(rng: Generator) -> Array:
    """The cells of random points, as of stones, leather or foliage."""
    count = int(math.exp(rng.uniform(3, 7)))
    points = np.ones((TILE, TILE), np.uint8)
    points[rng.integers(0, TILE, count), rng.integers(0, TILE, count)] = 0
    padded = np.pad(points, TILE // 4, mode="wrap")
    distance, labels = cv2.distanceTransformWithLabels(padded, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    inner = slice(TILE // 4, -TILE // 4)
    rows, columns = np.nonzero(padded == 0)
    # the copies of a point beyond the border have its tone
    tones = rng.uniform(0, 1, (TILE, TILE))
    tone_of = np.zeros(labels.max() + 1)
    tone_of[labels[rows, columns]] = tones[(rows - TILE // 4) % TILE, (columns - TILE // 4) % TILE]
    size = TILE / math.sqrt(count)
    mix = rng.uniform(0, 1)
    field = mix * tone_of[labels[inner, inner]] - (1 - mix) * 1.5 * distance[inner, inner] / size
    padded = np.pad(field.astype(np.float32), 4, mode="wrap")
    blurred = np.asarray(cv2.GaussianBlur(padded, (0, 0), 0.7), np.float32)[4:-4, 4:-4]
    return blurred + rng.uniform(0.0, 0.1) * noise(rng, exponent=1.0)


def _halved(canvas: npt.NDArray[Any]) -> Array:
    return np.asarray(cv2.resize(canvas.astype(np.float32), (TILE, TILE), interpolation=cv2.INTER_AREA), np.float32)


PATTERNS: dict[str, Callable[[Generator], Array]] = {
    "multi_octave": _multi_octave,
    "cells": _cells,
    "speckle": _speckle,
    "text": _text,
    "ridges": _ridges,
    "dots": _dots,
    "grain": _grain,
    "stripes": _stripes,
    "bricks": _bricks,
    "strokes": _strokes,
    "checkers": _checkers,
    "soft": _soft,
}
"""The kinds of pattern by name."""
