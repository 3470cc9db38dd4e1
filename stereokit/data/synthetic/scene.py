"""A scene: surfaces with outlines and textures, and which of them each view sees where."""

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from stereokit.data.datasets.dataset import Mask
from stereokit.data.synthetic.shapes import Shape
from stereokit.data.synthetic.surfaces import Array, Surface
from stereokit.data.synthetic.textures import Texture
from stereokit.errors import InputError

__all__ = ["Layer", "Scene", "View", "hidden"]

View: TypeAlias = Literal["left", "right"]

_SAME_SURFACE = 0.01  # pixels of disparity


@dataclass(frozen=True, eq=False)
class Layer:
    """A textured piece of surface.

    Attributes:
        surface: its geometry.
        texture: its colours.
        shape: its outline around the surface's centre; None where it has no end.
    """

    surface: Surface
    texture: Texture
    shape: Shape | None = None

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
