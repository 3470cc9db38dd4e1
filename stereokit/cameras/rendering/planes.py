"""Flat rectangles in space, and where rays meet them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["Plane", "hit"]


@dataclass(frozen=True, eq=False)
class Plane:
    """A picture in space.

    Attributes:
        picture: (h, w) or (h, w, 3) uint8.
        per_metre: pixels of the picture.
        turn: (3, 3), from the axes of the picture (x right, y down, z away from who looks at it) to those of the
            camera.
        centre: (3,), of the picture in the axes of the camera, in metres.
    """

    picture: npt.NDArray[np.uint8]
    per_metre: float
    turn: npt.NDArray[np.float64]
    centre: npt.NDArray[np.float64]

    def moved(self, turn: npt.NDArray[np.float64], move: npt.NDArray[np.float64]) -> "Plane":
        """The plane in the axes of another camera, where X' = turn X + move."""
        return Plane(self.picture, self.per_metre, turn @ self.turn, turn @ self.centre + move)

    def outline(self) -> npt.NDArray[np.float64]:
        """Points (N, 3) along its border, in the axes of the camera."""
        height, width = self.picture.shape[:2]
        along = np.linspace(-0.5, 0.5, 20)
        ends = np.full_like(along, 0.5)
        border = np.concatenate(
            [np.stack(pair, axis=1) for pair in ((along, ends), (along, -ends), (ends, along), (-ends, along))]
        )
        return border * [width, height] / self.per_metre @ self.turn[:, :2].T + self.centre

    def meet(self, rays: npt.NDArray[np.float64]) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
        """Depth along the optical axis, and column and row of the picture, where rays (..., 3) with z = 1 meet it.

        Depth is infinite where a ray meets the plane behind the camera or beside the picture.
        """
        normal = self.turn[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (normal @ self.centre) / (rays @ normal)
            place = (rays * depth[..., None] - self.centre) @ self.turn[:, :2] * self.per_metre
        height, width = self.picture.shape[:2]
        columns, rows = place[..., 0] + (width - 1) / 2, place[..., 1] + (height - 1) / 2
        inside = (np.abs(place[..., 0]) <= width / 2) & (np.abs(place[..., 1]) <= height / 2) & (depth > 0)
        return np.where(inside, depth, np.inf), columns, rows


def hit(planes: Sequence[Plane], rays: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Depth along the optical axis of the nearest plane that each ray meets, infinite where there is none.

    Args:
        planes: in the axes of the camera.
        rays: (..., 3), with z = 1.

    >>> wall = Plane(np.zeros((10, 10), np.uint8), 10.0, np.eye(3), np.array([0.0, 0.0, 2.0]))
    >>> hit([wall], np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])).tolist()
    [2.0, inf]
    """
    return np.min([plane.meet(rays)[0] for plane in planes], axis=0)
