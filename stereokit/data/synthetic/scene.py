"""A scene: surfaces with outlines and textures, and which of them each view sees where."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import cv2
import numpy as np

from stereokit.data.datasets.dataset import Mask
from stereokit.data.synthetic.shapes import Shape
from stereokit.data.synthetic.surfaces import Array, Surface
from stereokit.data.synthetic.textures import Image, Texture
from stereokit.errors import InputError

__all__ = ["Layer", "Reflection", "Scene", "View", "hidden"]

View: TypeAlias = Literal["left", "right"]

_SAME_SURFACE = 0.01  # pixels of disparity


@dataclass(frozen=True, eq=False)
class Reflection:
    """What a glossy surface mirrors: it seems to lie behind the surface, and has a disparity of its own.

    Attributes:
        texture: its colours.
        disparity: in pixels, the same all over.
        strength: its part in what is seen, from 0 to 1.
    """

    texture: Texture
    disparity: float
    strength: float


@dataclass(frozen=True, eq=False)
class Layer:
    """A textured piece of surface.

    Attributes:
        surface: its geometry.
        texture: its colours.
        shape: its outline around the surface's centre; None where it has no end.
        shade: brightness of the light that falls on it, as greys; None where that is even.
        reflection: what it mirrors; None where it is dull.
    """

    surface: Surface
    texture: Texture
    shape: Shape | None = None
    shade: Texture | None = None
    reflection: Reflection | None = None

    def seen(self, x: Array, v: Array, view: View) -> tuple[Array, Array, Array | None]:
        """What a view sees of the layer alone at columns x (rows, columns) and rows v (rows, 1).

        Returns:
            The left view's column of the surface point, its disparity, and the signed distance from the outline.
        """
        if view == "left":
            u, disparity = x, self.surface.disparity_at(x, v)
        else:
            u = self.surface.left_columns(x, v)
            disparity = u - x
        if self.shape is None:
            return u, disparity, None
        u0, v0 = self.surface.centre
        return u, disparity, self.shape.distance(u - np.float32(u0), v - np.float32(v0))

    def colours(self, x: Array, u: Array, v: Array, disparity: Array, view: View) -> Image:
        """The colours (rows, columns, 3) that a view sees at its columns x, see `seen` for the others.

        All but reflections is fixed to the surface, and so the same from both views.
        """
        colours = self.texture.colours(u, v, disparity)
        if self.shade is not None:
            brightness = self.shade.colours(u, v, disparity)
            colours = np.asarray(cv2.multiply(colours, brightness, scale=1 / 255), np.uint8)
        if self.reflection is not None:
            mirrored, strength = self.reflection.texture, self.reflection.strength
            far = np.full_like(disparity, self.reflection.disparity)
            seen = mirrored.colours(x if view == "left" else x + far, v, far)
            colours = np.asarray(cv2.addWeighted(colours, 1 - strength, seen, strength, 0), np.uint8)
        return colours

    def window(self, view: View, size: tuple[int, int], reach: tuple[float, float] = (0.0, 0.0)) -> tuple[slice, slice]:
        """Rows and columns of a view outside of which the layer is not seen.

        Args:
            view: which.
            size: height and width of the view.
            reach: lowest and highest offset, where not the pixels themselves are looked at but places to their right.
        """
        height, width = size
        if self.shape is None:
            return slice(0, height), slice(0, width)
        u0, v0 = self.surface.centre
        half_width, half_height = (half + 1.0 for half in self.shape.extent)
        low, high = self.surface.span(half_width, half_height) if view == "right" else (0.0, 0.0)
        first, last = u0 - half_width - high - reach[1], u0 + half_width - low - reach[0]
        return _slice(v0 - half_height, v0 + half_height, height), _slice(first, last, width)


@dataclass(frozen=True, eq=False)
class Scene:
    """What there is to see.

    Attributes:
        size: height and width of the views.
        layers: those without an end first, then from far to near. At each pixel the one of the largest disparity is
            seen, whatever the order.

    Raises:
        InputError: all layers have an end.
    """

    size: tuple[int, int]
    layers: tuple[Layer, ...]

    def __post_init__(self) -> None:
        if all(layer.shape is not None for layer in self.layers):
            raise InputError("a scene needs a layer without an end behind the others, so that all pixels see something")


def hidden(scene: Scene, view: View, disparity: Array) -> Mask:
    """Where a pixel of a view is not seen from the other one, (H, W).

    Its match lies outside of the other view, or another surface stands before it there, at exactly that place.

    Args:
        scene: what was rendered.
        view: whose pixels are asked for.
        disparity: of that view.
    """
    height, width = scene.size
    other: View = "right" if view == "left" else "left"
    offset = -disparity if view == "left" else disparity
    match = np.arange(width, dtype=np.float32) + offset
    rows = np.arange(height, dtype=np.float32)[:, None]
    result: Mask = (match < 0) | (match > width - 1)
    reach = float(offset.min()), float(offset.max())
    for layer in scene.layers:
        window = layer.window(other, scene.size, reach)
        if window[1].start >= window[1].stop or window[0].start >= window[0].stop:
            continue
        _, nearer, outside = layer.seen(match[window], rows[window[0]], other)
        before = nearer > disparity[window] + np.float32(_SAME_SURFACE)
        if outside is not None:
            before &= outside < 0
        result[window] |= before
    return result


def _slice(first: float, last: float, size: int) -> slice:
    return slice(min(max(int(np.floor(first)), 0), size), min(max(int(np.ceil(last)) + 1, 0), size))
