"""Shapes and reliefs of random things."""

import math

import numpy as np

from stereokit.data.synthetic.shapes import Blob, Box, Ellipse, Lattice, Polygon, Shape, Wire
from stereokit.data.synthetic.surfaces import Wave

__all__ = ["clipped_normal", "ripples", "solid_shape", "thin_shape"]

Generator = np.random.Generator


def solid_shape(rng: Generator, height: int, width: int) -> Shape:
    """A box, polygon, ellipse, ring or blob that suits views of this size."""
    half_width = width * math.exp(rng.uniform(math.log(0.02), math.log(0.25)))
    half_height = min(half_width * math.exp(rng.normal(0, 0.5)), 0.6 * height)
    turned = float(rng.uniform(-math.pi, math.pi)) if rng.random() < 0.5 else 0.0
    kind = rng.choice(5, p=(0.35, 0.25, 0.15, 0.07, 0.18))
    if kind == 0:
        return Box(half_width, half_height, turned)
    if kind == 1:
        corners = int(rng.integers(3, 8))
        turns = 2 * math.pi * (np.arange(corners) + rng.uniform(-0.2, 0.2, corners)) / corners + turned
        stretch = np.hypot(half_width * np.cos(turns), half_height * np.sin(turns))
        return Polygon(tuple(map(float, turns)), tuple(map(float, stretch)))
    if kind == 2:
        return Ellipse(half_width, half_height, turned)
    if kind == 3:
        return Ellipse(half_width, half_height, turned, hole=float(rng.uniform(0.3, 0.9)))
    lobes = tuple(
        (int(k), float(rng.normal(0, 0.25 / k)), float(rng.uniform(0, 6.3))) for k in rng.choice(np.arange(2, 10), 3)
    )
    return Blob(min(half_width, half_height), lobes)


def thin_shape(rng: Generator, height: int, width: int) -> Shape:
    """A bar, wire or lattice that suits views of this size."""
    kind = rng.choice(3, p=(0.45, 0.25, 0.3))
    thickness = math.exp(rng.uniform(math.log(1.0), math.log(9.0)))
    length = height * rng.uniform(0.15, 0.9)
    if kind == 0:
        upright = rng.random() < 0.6
        angle = clipped_normal(rng, 0.08, 0.3) if upright else float(rng.uniform(-math.pi, math.pi))
        return Box(thickness / 2, length, angle)
    if kind == 1:
        swing, frequency = height * rng.uniform(0.005, 0.08), 2 * math.pi / (height * rng.uniform(0.3, 1.5))
        return Wire(length, max(thickness / 4, 0.5), swing, frequency, float(rng.uniform(-math.pi, math.pi)))
    half_width = width * math.exp(rng.uniform(math.log(0.05), math.log(0.25)))
    period = math.exp(rng.uniform(math.log(8), math.log(50)))
    bar = max(period * rng.uniform(0.08, 0.5), 1.0)
    angle = 0.0 if rng.random() < 0.6 else float(rng.uniform(-math.pi, math.pi))
    return Lattice(half_width, height * rng.uniform(0.08, 0.45), period, bar, bool(rng.random() < 0.5), angle)


def ripples(rng: Generator) -> tuple[Wave, ...]:
    """One to three waves of a surface."""
    waves = []
    count = int(rng.integers(1, 4))
    for _ in range(count):
        frequency, direction = 2 * math.pi / math.exp(rng.uniform(math.log(25), math.log(300))), rng.uniform(0, math.pi)
        amplitude = min(rng.uniform(0.05, 0.35) / count / frequency, 8.0)
        across, down = frequency * math.cos(direction), frequency * math.sin(direction)
        waves.append(Wave(float(amplitude), float(across), float(down), float(rng.uniform(0, 2 * math.pi))))
    return tuple(waves)


def clipped_normal(rng: Generator, deviation: float, most: float) -> float:
    """A normally distributed number of mean 0, within -most and most."""
    return float(np.clip(rng.normal(0, deviation), -most, most))
