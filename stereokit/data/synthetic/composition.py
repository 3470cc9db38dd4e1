"""What is in a random scene: a room, a street, a table or a heap of things."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from stereokit.data.synthetic.patterns import TILE
from stereokit.data.synthetic.scene import Layer, Reflection, Scene
from stereokit.data.synthetic.shapes import Blob, Box, Ellipse, Lattice, Polygon, Shape, Wire
from stereokit.data.synthetic.surfaces import Surface, Wave
from stereokit.data.synthetic.textures import Ground, TextureBank
from stereokit.errors import ConfigError

__all__ = ["Composition"]

Generator = np.random.Generator

_STEEPEST_WALL = 0.7
_SMALLEST_RANGE = 4.0


@dataclass(frozen=True, kw_only=True)
class Composition:
    """How random scenes are put together.

    Attributes:
        size: height and width of the views in pixels.
        max_disparity: the largest disparity there is, in pixels.
        disparity_exponent: things stand at max_disparity r ** exponent with r uniform: 1 spreads disparity evenly, more
            makes most things far.
        range_exponent: each scene has a largest disparity of its own, max_disparity r ** range_exponent with r uniform:
            0 gives all scenes the same, more makes most scenes far as a whole.
        objects: fewest and most things a scene has besides its walls, ground and sky.
        thin: how many of them are bars, wires, lattices or plants.
        alike: how many surfaces have the texture of another one, before which they hardly stand out.
        shaded: how many surfaces are lit unevenly or lie in part in shadow.
        glossy: how many surfaces mirror something, which moves between the views by another disparity than their own.

    Raises:
        ConfigError: a size below 32 x 32, or values out of range.
    """

    size: tuple[int, int] = (256, 512)
    max_disparity: float = 96.0
    disparity_exponent: float = 1.3
    range_exponent: float = 0.0
    objects: tuple[int, int] = (3, 13)
    thin: float = 0.3
    alike: float = 0.0
    shaded: float = 0.0
    glossy: float = 0.0

    def __post_init__(self) -> None:
        height, width = self.size
        if min(height, width) < 32:
            raise ConfigError(f"synthetic scenes have at least 32 x 32 pixels, got size {height} x {width}")
        if not _SMALLEST_RANGE <= self.max_disparity <= width:
            raise ConfigError(
                f"max_disparity must lie from {_SMALLEST_RANGE:g} to the width {width}, got {self.max_disparity}"
            )
        if not self.disparity_exponent > 0:
            raise ConfigError(f"disparity_exponent must be positive, got {self.disparity_exponent}")
        for name in ("thin", "alike", "shaded", "glossy"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} must be a part from 0 to 1, got {getattr(self, name)}")
        if not self.range_exponent >= 0:
            raise ConfigError(f"range_exponent must be at least 0, got {self.range_exponent}")
        if not 0 <= self.objects[0] <= self.objects[1]:
            raise ConfigError(f"objects must be the fewest and the most of them, got {self.objects}")

    def scene(self, rng: Generator, bank: TextureBank) -> Scene:
        """A random scene."""
        if self.range_exponent:
            largest = max(self.max_disparity * rng.uniform() ** self.range_exponent, _SMALLEST_RANGE)
            return replace(self, max_disparity=largest, range_exponent=0.0).scene(rng, bank)
        setting = _SETTINGS[rng.choice(len(_SETTINGS), p=_HOW_OFTEN)]
        backdrop = setting(self, rng, bank)
        things: list[Layer] = []
        for _ in range(int(rng.integers(self.objects[0], self.objects[1] + 1))):
            things += self._thing(rng, bank, backdrop)
        things.sort(key=lambda layer: layer.surface.disparity)
        layers = [*backdrop, *things]
        return Scene(self.size, tuple(self._finished(rng, bank, layer, layers) for layer in layers))

    def _finished(self, rng: Generator, bank: TextureBank, layer: Layer, layers: list[Layer]) -> Layer:
        """The layer in its light, the sky as it is. This is drawn behind all geometry, which stays the same."""
        if layer.shape is None and layer.surface.slope == (0.0, 0.0) and layer.surface.disparity < 1:
            return layer
        if rng.random() < self.alike:
            others = [other for other in layers if other is not layer] or [layer]
            other = others[rng.integers(len(others))]
            texture = replace(other.texture, origin=tuple(rng.uniform(0, TILE, 2)), ground=layer.texture.ground)
            layer = replace(layer, texture=texture)
        if rng.random() < self.shaded:
            layer = replace(layer, shade=bank.shade(rng))
        if rng.random() < self.glossy:
            disparity = self._farthest(layer) * float(rng.uniform(0, 0.9))
            strength = math.exp(rng.uniform(math.log(0.08), math.log(0.5)))
            layer = replace(layer, reflection=Reflection(bank.texture(rng, plain=0.0), disparity, strength))
        return layer

    def _farthest(self, layer: Layer) -> float:
        """A disparity that the layer has nowhere less of, where it is seen."""
        extent = self._all_over(layer.surface) if layer.shape is None else layer.shape.extent
        low, _ = layer.surface.span(*extent)
        return max(low, 0.0)

    def fitted(self, surface: Surface, half_width: float, half_height: float) -> Surface:
        """The surface with its relief flattened until disparity stays within bounds."""
        middle = min(max(surface.disparity, 0.0), self.max_disparity)
        surface = replace(surface, disparity=middle)
        low, high = surface.span(half_width, half_height)
        part = min(
            1.0,
            middle / (middle - low) if low < 0 else 1.0,
            (self.max_disparity - middle) / (high - middle) if high > self.max_disparity else 1.0,
        )
        # a little less, for rounding
        return surface if part == 1 else _flattened(surface, 0.999 * part)

    @property
    def wide(self) -> float:
        """Columns of the left view up to the last one that the right view may see."""
        return self.size[1] + self.max_disparity

    def backdrop(self, surface: Surface) -> Surface:
        """The surface, within bounds all over both views."""
        return self.fitted(surface, *self._all_over(surface))

    def _all_over(self, surface: Surface) -> tuple[float, float]:
        """How far from its centre a surface without an end is seen, in columns and in rows."""
        u0, v0 = surface.centre
        return max(u0, self.wide - u0), max(v0, self.size[0] - v0)

    def _disparity(self, rng: Generator) -> float:
        return float(self.max_disparity * rng.uniform() ** self.disparity_exponent)

    def _thing(self, rng: Generator, bank: TextureBank, backdrop: tuple[Layer, ...]) -> list[Layer]:
        height, width = self.size
        is_thin = rng.random() < self.thin
        u, v = rng.uniform(0, width + 0.3 * self.max_disparity), rng.uniform(0.05, 1.1) * height
        behind = max(float(layer.surface.disparity_at(_point(u), _point(v)).item()) for layer in backdrop)
        behind = min(max(behind, 0.0), self.max_disparity)
        disparity = self._disparity(rng)
        if disparity < behind:
            disparity = behind + (self.max_disparity - behind) * rng.uniform() ** 2
        if is_thin and rng.random() < 0.25:
            return self._plant(rng, bank, (u, v), disparity)
        shape = _thin_shape(rng, height, width) if is_thin else _solid_shape(rng, height, width)
        if rng.random() < 0.4:  # stands on what is below it
            v = min(v, height) - shape.extent[1] * rng.uniform(0.3, 1.0)
        surface = self._relief(rng, shape, (u, v), disparity, flat=is_thin)
        texture = bank.texture(rng, plain=0.5 if is_thin else 0.15)
        front = Layer(surface, texture, shape)
        if isinstance(shape, Box) and not is_thin and shape.angle == 0 and rng.random() < 0.4:
            return [front, self._side(rng, bank, front, shape)]
        return [front]

    def _relief(
        self, rng: Generator, shape: Shape, centre: tuple[float, float], disparity: float, *, flat: bool
    ) -> Surface:
        half_width, half_height = shape.extent
        kind = rng.choice(3, p=(0.35, 0.35, 0.3)) if not flat else int(rng.random() < 0.3)
        slope = (0.0, 0.0) if kind == 0 else (_normal(rng, 0.12, 0.4), _normal(rng, 0.12, 0.4))
        bend, reach = (0.0, 0.0), 0.0
        waves: tuple[Wave, ...] = ()
        if kind == 2 and rng.random() < 0.5:
            reach = half_width
            bend = _normal(rng, 0.1, 0.17) / half_width, _normal(rng, 0.1, 0.2) / half_height
        elif kind == 2:
            waves = _ripples(rng)
        surface = Surface(centre, disparity, slope, bend, reach, waves)
        return self.fitted(surface, half_width + 2, half_height + 2)

    def _side(self, rng: Generator, bank: TextureBank, front: Layer, shape: Box) -> Layer:
        """The side of a box, which runs back from an edge of its front."""
        surface = front.surface
        deep = rng.uniform(0.1, 0.6) * surface.disparity
        half = max(deep / rng.uniform(0.3, 0.7), 8.0) / 2
        side = 1 if rng.random() < 0.5 else -1
        edge = float(
            surface.disparity_at(_point(surface.centre[0] + side * shape.half_width), _point(surface.centre[1])).item()
        )
        slope = -side * deep / (2 * half)
        centre = surface.centre[0] + side * (shape.half_width + half), surface.centre[1]
        face = Surface(centre, edge - deep / 2, (slope, surface.slope[1]))
        return Layer(
            self.fitted(face, half + 2, shape.half_height + 2), bank.texture(rng), Box(half, shape.half_height)
        )

    def _plant(self, rng: Generator, bank: TextureBank, foot: tuple[float, float], disparity: float) -> list[Layer]:
        """Leaves that start at one place, each at its own disparity."""
        height = self.size[0]
        texture = bank.texture(rng, plain=0.4)
        leaves = []
        for _ in range(int(rng.integers(4, 9))):
            half, angle = height * rng.uniform(0.08, 0.25), _normal(rng, 0.7, 1.5) - math.pi / 2
            shape = Ellipse(half, max(half * rng.uniform(0.04, 0.25), 0.8), angle)
            centre = foot[0] + half * math.cos(angle), foot[1] + half * math.sin(angle)
            near = min(disparity * rng.uniform(0.85, 1.15), self.max_disparity)
            slope = _normal(rng, 0.1, 0.3), _normal(rng, 0.1, 0.3)
            surface = self.fitted(Surface(centre, near, slope), *(side + 2 for side in shape.extent))
            leaves.append(Layer(surface, replace(texture, origin=tuple(rng.uniform(0, 500, 2))), shape))
        return leaves


def _room(of: Composition, rng: Generator, bank: TextureBank) -> tuple[Layer, ...]:
    """A far wall with a floor, and now and then a ceiling and walls to the sides."""
    height, width = of.size
    wall = of.max_disparity * rng.uniform(0.02, 0.5)
    slope = _normal(rng, 0.06, 0.25), _normal(rng, 0.05, 0.2)
    waves = _ripples(rng) if rng.random() < 0.2 else ()
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


def _street(of: Composition, rng: Generator, bank: TextureBank) -> tuple[Layer, ...]:
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


def _table(of: Composition, rng: Generator, bank: TextureBank) -> tuple[Layer, ...]:
    """One slanted ground all over, flat or uneven, seen from above or from nearby."""
    height, width = of.size
    top, bottom = np.sort(rng.uniform(0.05, 0.8, 2)) * of.max_disparity
    if rng.random() < 0.15:
        top, bottom = bottom, top
    waves = _ripples(rng) if rng.random() < 0.35 else ()
    slope = _normal(rng, 0.05, 0.2), float(bottom - top) / height
    surface = of.backdrop(Surface((width / 2, height / 2), float(top + bottom) / 2, slope, waves=waves))
    return (Layer(surface, bank.texture(rng)),)


def _heap(of: Composition, rng: Generator, bank: TextureBank) -> tuple[Layer, ...]:
    """A far board, and things before it anywhere."""
    height, width = of.size
    slope = _normal(rng, 0.08, 0.3), _normal(rng, 0.08, 0.3)
    far = Surface((width / 2, height / 2), of.max_disparity * rng.uniform(0, 0.4), slope)
    return (Layer(of.backdrop(far), bank.texture(rng, plain=0.25)),)


_SETTINGS: tuple[Callable[[Composition, Generator, TextureBank], tuple[Layer, ...]], ...] = (
    _room,
    _street,
    _table,
    _heap,
)
_HOW_OFTEN = (0.3, 0.3, 0.25, 0.15)


def _floor(of: Composition, bank: TextureBank, rng: Generator, *, row: float, far: float, near: float) -> Layer:
    """A ground of disparity `far` at a row and `near` at the lower border."""
    height, width = of.size
    steep = (near - far) / (height - row)
    surface = _below(of, Surface((width / 2, row), far, (_normal(rng, 0.01, 0.04), steep)))
    steep = surface.slope[1]
    ground = Ground(far + steep * (height - row), width / 2, row - far / steep, height - row + far / steep)
    return Layer(surface, bank.texture(rng, plain=0.25, ground=ground))


def _below(of: Composition, surface: Surface) -> Surface:
    """A plane that stays below the largest disparity. Where it falls below 0 something else must stand before it."""
    u0, v0 = surface.centre
    b, c = surface.slope
    high = max(b * (of.wide - u0), -b * u0) + max(c * (of.size[0] - v0), -c * v0)
    room = of.max_disparity - surface.disparity
    part = min(1.0, 0.999 * room / high) if high > 0 else 1.0
    return replace(surface, slope=(part * b, part * c))


def _solid_shape(rng: Generator, height: int, width: int) -> Shape:
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


def _thin_shape(rng: Generator, height: int, width: int) -> Shape:
    kind = rng.choice(3, p=(0.45, 0.25, 0.3))
    thickness = math.exp(rng.uniform(math.log(1.0), math.log(9.0)))
    length = height * rng.uniform(0.15, 0.9)
    if kind == 0:
        upright = rng.random() < 0.6
        angle = _normal(rng, 0.08, 0.3) if upright else float(rng.uniform(-math.pi, math.pi))
        return Box(thickness / 2, length, angle)
    if kind == 1:
        swing, frequency = height * rng.uniform(0.005, 0.08), 2 * math.pi / (height * rng.uniform(0.3, 1.5))
        return Wire(length, max(thickness / 4, 0.5), swing, frequency, float(rng.uniform(-math.pi, math.pi)))
    half_width = width * math.exp(rng.uniform(math.log(0.05), math.log(0.25)))
    period = math.exp(rng.uniform(math.log(8), math.log(50)))
    bar = max(period * rng.uniform(0.08, 0.5), 1.0)
    angle = 0.0 if rng.random() < 0.6 else float(rng.uniform(-math.pi, math.pi))
    return Lattice(half_width, height * rng.uniform(0.08, 0.45), period, bar, bool(rng.random() < 0.5), angle)


def _ripples(rng: Generator) -> tuple[Wave, ...]:
    waves = []
    count = int(rng.integers(1, 4))
    for _ in range(count):
        frequency, direction = 2 * math.pi / math.exp(rng.uniform(math.log(25), math.log(300))), rng.uniform(0, math.pi)
        amplitude = min(rng.uniform(0.05, 0.35) / count / frequency, 8.0)
        across, down = frequency * math.cos(direction), frequency * math.sin(direction)
        waves.append(Wave(float(amplitude), float(across), float(down), float(rng.uniform(0, 2 * math.pi))))
    return tuple(waves)


def _flattened(surface: Surface, part: float) -> Surface:
    return replace(
        surface,
        slope=(part * surface.slope[0], part * surface.slope[1]),
        bend=(part * surface.bend[0], part * surface.bend[1]),
        waves=tuple(replace(wave, amplitude=part * wave.amplitude) for wave in surface.waves),
    )


def _normal(rng: Generator, deviation: float, most: float) -> float:
    return float(np.clip(rng.normal(0, deviation), -most, most))


def _point(value: float) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    return np.array([[value]], np.float32)
