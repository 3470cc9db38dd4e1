"""Outlines of surfaces as signed distances, so that both views cut them at the same place exactly."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from stereokit.data.synthetic.surfaces import Array

__all__ = ["Blob", "Box", "Ellipse", "Lattice", "Polygon", "Shape", "Wire"]


class Shape(Protocol):
    """An outline around a centre, in the left view's pixels."""

    @property
    def extent(self) -> tuple[float, float]:
        """Half width and half height of a rectangle around it."""
        ...

    def distance(self, du: Array, dv: Array) -> Array:
        """About the distance from the outline in pixels, negative inside, at offsets from the centre.

        Args:
            du: (rows, columns).
            dv: (rows, 1).
        """
        ...


@dataclass(frozen=True)
class _Turned:
    """What fills a turned rectangle.

    Attributes:
        half_width: before it is turned.
        half_height: likewise.
        angle: in radians.
    """

    half_width: float
    half_height: float
    angle: float = 0.0

    @property
    def extent(self) -> tuple[float, float]:
        """See `Shape`."""
        return _turned_extent(self.half_width, self.half_height, self.angle)


@dataclass(frozen=True)
class Box(_Turned):
    """A rectangle; a bar where it is thin.

    Attributes:
        half_width: before it is turned.
        half_height: likewise.
        angle: in radians.
    """

    def distance(self, du: Array, dv: Array) -> Array:
        """See `Shape`."""
        s, t = _turn(du, dv, self.angle)
        return _outside_box(s, t, self.half_width, self.half_height)


@dataclass(frozen=True)
class Ellipse(_Turned):
    """An ellipse, or a ring.

    Attributes:
        half_width: before it is turned.
        half_height: likewise.
        angle: in radians.
        hole: size of the hole as a part of the ellipse; 0 has none.
    """

    hole: float = 0.0

    def distance(self, du: Array, dv: Array) -> Array:
        """See `Shape`."""
        s, t = _turn(du, dv, self.angle)
        s, t = s * np.float32(1 / self.half_width), t * np.float32(1 / self.half_height)
        radius = np.sqrt(s * s + t * t)
        # the gradient of the radius turns it into pixels
        s, t = s * np.float32(1 / self.half_width), t * np.float32(1 / self.half_height)
        pixels = radius / np.sqrt(s * s + t * t + np.float32(1e-12))
        outside = (radius - 1) * pixels
        return np.maximum(outside, (np.float32(self.hole) - radius) * pixels) if self.hole else outside


@dataclass(frozen=True)
class Polygon:
    """A convex polygon: the points within all of some half planes.

    Attributes:
        angles: directions of the edges' normals in radians, sorted and less than pi apart.
        distances: of the edges from the centre.
    """

    angles: tuple[float, ...]
    distances: tuple[float, ...]

    @property
    def extent(self) -> tuple[float, float]:
        """See `Shape`."""
        corners = []
        for edge in range(len(self.angles)):
            first, second = self.angles[edge - 1], self.angles[edge]
            a, b = self.distances[edge - 1], self.distances[edge]
            area = math.sin(second - first)
            x = (a * math.sin(second) - b * math.sin(first)) / area
            y = (b * math.cos(first) - a * math.cos(second)) / area
            corners.append((abs(x), abs(y)))
        return max(x for x, _ in corners), max(y for _, y in corners)

    def distance(self, du: Array, dv: Array) -> Array:
        """See `Shape`."""
        result = np.full(np.broadcast_shapes(du.shape, dv.shape), -np.inf, np.float32)
        for angle, distance in zip(self.angles, self.distances, strict=True):
            edge = np.float32(math.cos(angle)) * du
            edge += np.float32(math.sin(angle)) * dv - np.float32(distance)
            np.maximum(result, edge, out=result)
        return result


@dataclass(frozen=True)
class Blob:
    """A rounded outline with lobes: radius r (1 + sum a cos(k angle + phase)).

    Attributes:
        radius: r.
        lobes: (k, a, phase) of each.
    """

    radius: float
    lobes: tuple[tuple[int, float, float], ...]

    @property
    def extent(self) -> tuple[float, float]:
        """See `Shape`."""
        largest = self.radius * (1 + sum(abs(size) for _, size, _ in self.lobes))
        return largest, largest

    def distance(self, du: Array, dv: Array) -> Array:
        """See `Shape`."""
        angle = np.arctan2(dv, du)
        outline = np.full_like(angle, self.radius)
        for count, size, phase in self.lobes:
            outline += np.float32(self.radius * size) * np.cos(count * angle + np.float32(phase))
        steepest = 1 + sum((count * size) ** 2 for count, size, _ in self.lobes) / 2
        result: Array = (np.sqrt(du * du + dv * dv) - outline) * np.float32(1 / math.sqrt(steepest))
        return result


@dataclass(frozen=True)
class Wire:
    """A thin line that swings like a sine.

    Attributes:
        half_length: before it is turned.
        half_width: of the line.
        swing: amplitude in pixels.
        frequency: radians a pixel.
        angle: in radians.
    """

    half_length: float
    half_width: float
    swing: float
    frequency: float
    angle: float = 0.0

    @property
    def extent(self) -> tuple[float, float]:
        """See `Shape`."""
        return _turned_extent(self.half_length, self.swing + 2 * self.half_width + 1, self.angle)

    def distance(self, du: Array, dv: Array) -> Array:
        """See `Shape`."""
        s, t = _turn(du, dv, self.angle)
        angle = np.float32(self.frequency) * s
        tilt = np.float32(self.swing * self.frequency) * np.cos(angle)
        across = np.abs(t - np.float32(self.swing) * np.sin(angle)) / np.sqrt(1 + tilt * tilt)
        result: Array = np.maximum(across - np.float32(self.half_width), np.abs(s) - np.float32(self.half_length))
        return result


@dataclass(frozen=True)
class Lattice:
    """Bars at equal distances within a rectangle: a fence, or a grid with holes.

    Attributes:
        half_width: of the rectangle.
        half_height: likewise.
        period: from bar to bar.
        bar: width of a bar.
        crossed: bars in both directions.
        angle: in radians.
    """

    half_width: float
    half_height: float
    period: float
    bar: float
    crossed: bool = False
    angle: float = 0.0

    @property
    def extent(self) -> tuple[float, float]:
        """See `Shape`."""
        return _turned_extent(self.half_width, self.half_height, self.angle)

    def distance(self, du: Array, dv: Array) -> Array:
        """See `Shape`."""
        s, t = _turn(du, dv, self.angle)
        bars = self._bars(s)
        if self.crossed:
            bars = np.minimum(bars, self._bars(t))
        result: Array = np.maximum(bars, _outside_box(s, t, self.half_width, self.half_height))
        return result

    def _bars(self, s: Array) -> Array:
        part = s * np.float32(1 / self.period)
        part -= np.rint(part)
        result: Array = np.abs(part) * np.float32(self.period) - np.float32(self.bar / 2)
        return result


def _turn(du: Array, dv: Array, angle: float) -> tuple[Array, Array]:
    if angle == 0:
        return du, dv
    cosine, sine = np.float32(math.cos(angle)), np.float32(math.sin(angle))
    return cosine * du + sine * dv, cosine * dv - sine * du


def _outside_box(s: Array, t: Array, half_width: float, half_height: float) -> Array:
    result: Array = np.maximum(np.abs(s) - np.float32(half_width), np.abs(t) - np.float32(half_height))
    return result


def _turned_extent(half_width: float, half_height: float, angle: float) -> tuple[float, float]:
    cosine, sine = abs(math.cos(angle)), abs(math.sin(angle))
    return cosine * half_width + sine * half_height, sine * half_width + cosine * half_height
