"""What stands behind the things of a random scene: a room, a street, a table or a far board."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from stereokit.data.synthetic.random_shapes import clipped_normal, ripples
from stereokit.data.synthetic.scene import Layer
from stereokit.data.synthetic.shapes import Box
from stereokit.data.synthetic.surfaces import Surface
from stereokit.data.synthetic.textures import Ground, TextureBank

if TYPE_CHECKING:
    from stereokit.data.synthetic.composition import Composition

__all__ = ["random_setting"]

Generator = np.random.Generator

_STEEPEST_WALL = 0.7


def random_setting(of: "Composition", rng: Generator, bank: TextureBank) -> tuple[Layer, ...]:
    """The layers of one of the settings."""
    return _SETTINGS[rng.choice(len(_SETTINGS), p=_HOW_OFTEN)](of, rng, bank)


def _room(of: "Composition", rng: Generator, bank: TextureBank) -> tuple[Layer, ...]:
    """A far wall with a floor, and now and then a ceiling and walls to the sides."""
    height, width = of.size
    wall = of.max_disparity * rng.uniform(0.02, 0.5)
    slope = clipped_normal(rng, 0.06, 0.25), clipped_normal(rng, 0.05, 0.2)
    waves = ripples(rng) if rng.random() < 0.2 else ()
    far = of.backdrop(Surface((width / 2, height / 2), wall, slope, waves=waves))
    layers = [Layer(far, bank.texture(rng, plain=0.3))]
    foot = height * rng.uniform(0.4, 0.9)
    near = wall + (of.max_disparity - wall) * rng.uniform(0.2, 0.9)
    layers.append(_floor(of, bank, rng, row=foot, far=wall, near=near))
    if rng.random() < 0.3:
        top = height * rng.uniform(0.05, 0.3)
        above = Surface((width / 2, top), wall, (0.0, -rng.uniform(0.1, 0.9) * (of.max_disparity - wall) / height))
        layers.append(Layer(_below(of, above), bank.texture(rng, plain=0.5)))
    for side in (-1, 1):
        if rng.random() < 0.3:
            column = width * (0.5 + side * rng.uniform(0.15, 0.45))
            steep = min(rng.uniform(0.1, 1) * (of.max_disparity - wall) / (width / 4), _STEEPEST_WALL)
            beside = Surface((column, height / 2), wall, (side * steep, 0.0))
            layers.append(Layer(_below(of, beside), bank.texture(rng, plain=0.3)))
    return tuple(layers)


def _street(of: "Composition", rng: Generator, bank: TextureBank) -> tuple[Layer, ...]:
    """Sky at next to no disparity, a road that runs to the horizon, and fronts of houses."""
    height, width = of.size
    # not quite 0, which stands for unknown
    sky = Surface((0.0, 0.0), max(float(rng.uniform(0, 0.6) * (rng.random() < 0.6)), 0.01))
    horizon = height * rng.uniform(0.25, 0.65)
    layers = [Layer(sky, bank.sky(rng))]
    near = of.max_disparity * rng.uniform(0.3, 0.95)
    layers.append(_floor(of, bank, rng, row=horizon, far=0.0, near=near))
    for _ in range(int(rng.integers(0, 5))):
        half = width * math.exp(rng.uniform(math.log(0.04), math.log(0.3)))
        u = rng.uniform(0, width)
        top = horizon - height * rng.uniform(0.02, 0.6)
        foot = horizon + rng.uniform(0.01, 0.4) * (height - horizon)
        shape = Box(half, (foot + 20 - top) / 2)
        disparity = near * (foot - horizon) / (height - horizon)
        slope = (
            (np.sign(u - width / 2) * rng.uniform(0, 0.9) * disparity / half, 0.0) if rng.random() < 0.5 else (0.0, 0.0)
        )
        slope = (float(np.clip(slope[0], -_STEEPEST_WALL, _STEEPEST_WALL)), 0.0)
        surface = Surface((u, (top + foot + 20) / 2), disparity, slope)
        layers.append(Layer(of.fitted(surface, half + 2, shape.half_height + 2), bank.texture(rng, plain=0.2), shape))
    return tuple(layers)


def _table(of: "Composition", rng: Generator, bank: TextureBank) -> tuple[Layer, ...]:
    """One slanted ground all over, flat or uneven, seen from above or from nearby."""
    height, width = of.size
    top, bottom = np.sort(rng.uniform(0.05, 0.8, 2)) * of.max_disparity
    if rng.random() < 0.15:
        top, bottom = bottom, top
    waves = ripples(rng) if rng.random() < 0.35 else ()
    slope = clipped_normal(rng, 0.05, 0.2), float(bottom - top) / height
    surface = of.backdrop(Surface((width / 2, height / 2), float(top + bottom) / 2, slope, waves=waves))
    return (Layer(surface, bank.texture(rng)),)


def _heap(of: "Composition", rng: Generator, bank: TextureBank) -> tuple[Layer, ...]:
    """A far board, and things before it anywhere."""
    height, width = of.size
    slope = clipped_normal(rng, 0.08, 0.3), clipped_normal(rng, 0.08, 0.3)
    far = Surface((width / 2, height / 2), of.max_disparity * rng.uniform(0, 0.4), slope)
    return (Layer(of.backdrop(far), bank.texture(rng, plain=0.25)),)


def _floor(of: "Composition", bank: TextureBank, rng: Generator, *, row: float, far: float, near: float) -> Layer:
    """A ground of disparity `far` at a row and `near` at the lower border."""
    height, width = of.size
    steep = (near - far) / (height - row)
    surface = _below(of, Surface((width / 2, row), far, (clipped_normal(rng, 0.01, 0.04), steep)))
    steep = surface.slope[1]
    ground = Ground(far + steep * (height - row), width / 2, row - far / steep, height - row + far / steep)
    return Layer(surface, bank.texture(rng, plain=0.25, ground=ground))


def _below(of: "Composition", surface: Surface) -> Surface:
    """A plane that stays below the largest disparity. Where it falls below 0 something else must stand before it."""
    u0, v0 = surface.centre
    b, c = surface.slope
    high = max(b * (of.wide - u0), -b * u0) + max(c * (of.size[0] - v0), -c * v0)
    room = of.max_disparity - surface.disparity
    part = min(1.0, 0.999 * room / high) if high > 0 else 1.0
    return replace(surface, slope=(part * b, part * c))


_SETTINGS: tuple[Callable[["Composition", Generator, TextureBank], tuple[Layer, ...]], ...] = (
    _room,
    _street,
    _table,
    _heap,
)
_HOW_OFTEN = (0.3, 0.3, 0.25, 0.15)
