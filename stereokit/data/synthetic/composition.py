"""What is in a random scene: a room, a street, a table or a heap of things."""

import math
from dataclasses import dataclass, replace

import numpy as np

from stereokit.data.synthetic.patterns import TILE
from stereokit.data.synthetic.random_shapes import clipped_normal, ripples, solid_shape, thin_shape
from stereokit.data.synthetic.scene import Layer, Reflection, Scene
from stereokit.data.synthetic.settings import random_setting
from stereokit.data.synthetic.shapes import Box, Ellipse, Shape
from stereokit.data.synthetic.surfaces import Surface, Wave
from stereokit.data.synthetic.textures import TextureBank
from stereokit.errors import ConfigError

__all__ = ["Composition"]

Generator = np.random.Generator

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
        backdrop = random_setting(self, rng, bank)
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
        shape = thin_shape(rng, height, width) if is_thin else solid_shape(rng, height, width)
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
        slope = (0.0, 0.0) if kind == 0 else (clipped_normal(rng, 0.12, 0.4), clipped_normal(rng, 0.12, 0.4))
        bend, reach = (0.0, 0.0), 0.0
        waves: tuple[Wave, ...] = ()
        if kind == 2 and rng.random() < 0.5:
            reach = half_width
            bend = clipped_normal(rng, 0.1, 0.17) / half_width, clipped_normal(rng, 0.1, 0.2) / half_height
        elif kind == 2:
            waves = ripples(rng)
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
            half, angle = height * rng.uniform(0.08, 0.25), clipped_normal(rng, 0.7, 1.5) - math.pi / 2
            shape = Ellipse(half, max(half * rng.uniform(0.04, 0.25), 0.8), angle)
            centre = foot[0] + half * math.cos(angle), foot[1] + half * math.sin(angle)
            near = min(disparity * rng.uniform(0.85, 1.15), self.max_disparity)
            slope = clipped_normal(rng, 0.1, 0.3), clipped_normal(rng, 0.1, 0.3)
            surface = self.fitted(Surface(centre, near, slope), *(side + 2 for side in shape.extent))
            leaves.append(Layer(surface, replace(texture, origin=tuple(rng.uniform(0, 500, 2))), shape))
        return leaves


def _flattened(surface: Surface, part: float) -> Surface:
    return replace(
        surface,
        slope=(part * surface.slope[0], part * surface.slope[1]),
        bend=(part * surface.bend[0], part * surface.bend[1]),
        waves=tuple(replace(wave, amplitude=part * wave.amplitude) for wave in surface.waves),
    )


def _point(value: float) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    return np.array([[value]], np.float32)
