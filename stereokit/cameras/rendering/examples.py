"""A rig of two small cameras, boards held before it, and a scene of textured planes."""

import math
from collections.abc import Iterator

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.boards import Board
from stereokit.cameras.rendering.planes import Plane
from stereokit.cameras.rig import Camera, Model, Rig
from stereokit.cameras.targets import board_picture
from stereokit.data.synthetic import SyntheticScenes, render_view

__all__ = ["board_plane", "board_poses", "example_rig", "example_scene"]

_PINHOLE = (-0.12, 0.05, 4e-4, -3e-4)
_FISHEYE = (0.02, -0.01, 0.004, -0.001)
_PER_SQUARE = 42

Pose = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]


def example_rig(
    model: Model = "pinhole",
    *,
    baseline: float = 0.06,
    size: tuple[int, int] = (480, 640),
    field_of_view: float | None = None,
) -> Rig:
    """Two small cameras that are a little unlike, distorted, and turned against each other by about a degree.

    Args:
        model: of the lenses.
        baseline: in metres.
        size: height and width of the images.
        field_of_view: horizontal, in degrees; 63 by default, and 122 for fisheye lenses.

    >>> round(example_rig().left.fx), example_rig().translation[0] < 0
    (520, True)
    """
    height, width = size
    if model == "fisheye":
        focal = width / math.radians(122.2 if field_of_view is None else field_of_view)
    else:
        focal = width / 2 / math.tan(math.radians(63.2 if field_of_view is None else field_of_view) / 2)
    unit = width / 640
    lens = _FISHEYE if model == "fisheye" else _PINHOLE
    left = Camera(focal, focal + unit, width / 2 + 3 * unit, height / 2 - 3 * unit, width, height, lens, model)
    right = Camera(
        focal + 2 * unit, focal + 3 * unit, width / 2 - 4 * unit, height / 2 + 3 * unit, width, height, lens, model
    )
    turn = _rotation(0.6, -0.8, 0.5)
    move = -turn @ np.array([baseline, baseline / 60, -baseline / 75])
    return Rig(left, right, tuple(turn.ravel().tolist()), tuple(move.tolist()))


def board_poses(
    count: int, *, seed: int = 0, near: float = 0.35, far: float = 1.0, tilt: float = 35.0, wide: float = 0.75
) -> Iterator[Pose]:
    """Turn and centre of a board held before the left camera: all over its view, near and far, tilted every way.

    Args:
        count: of the poses.
        seed: of the tilts.
        near: the least distance in metres.
        far: the largest.
        tilt: the largest, in degrees about each axis.
        wide: how far to the side the board goes, as a part of its distance.
    """
    rng = np.random.default_rng(seed)
    for i in range(count):
        distance = near * (far / near) ** ((i % 5) / 4)
        across, down = (i * 0.618 % 1 - 0.5), (i * 0.755 % 1 - 0.5)
        centre = distance * np.array([across * wide, down * 0.75 * wide, 1.0])
        yield _rotation(*rng.uniform(-tilt, tilt, 2), rng.uniform(-15, 15)), centre


def board_plane(board: Board, turn: npt.NDArray[np.float64], centre: npt.NDArray[np.float64]) -> Plane:
    """A printed board, with a white border of a square."""
    per_metre = _PER_SQUARE / board.square
    return Plane(board_picture(board, per_metre, border=board.square), per_metre, turn, centre)


def example_scene(seed: int = 0) -> list[Plane]:
    """A back wall and four textured boards before it, 0.4 to 2.5 m from the left camera, in colour.

    Args:
        seed: of the textures.
    """
    pictures = SyntheticScenes(seed=seed, size=(600, 800), max_disparity=4, photometric=0, plain=0, objects=(40, 50))
    # where each is, how it is turned, and how wide it is, in metres and degrees
    placed = [
        ((0.0, 0.0, 2.5), (2, 6, 0), 4.6),
        ((-0.17, -0.06, 0.48), (6, 28, 4), 0.26),
        ((0.22, -0.10, 0.70), (-10, -25, -5), 0.34),
        ((0.10, 0.22, 0.85), (42, 4, 0), 0.6),
        ((-0.42, 0.20, 1.25), (0, 15, 2), 0.6),
    ]
    return [
        Plane(render_view(pictures.scene(i), "left").image, 800 / wide, _rotation(*angles), np.array(centre))
        for i, (centre, angles, wide) in enumerate(placed)
    ]


def _rotation(*degrees: float) -> npt.NDArray[np.float64]:
    return np.asarray(cv2.Rodrigues(np.radians(np.array(degrees, float)))[0], np.float64)
