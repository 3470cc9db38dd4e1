"""Lenses and pose of two cameras by least squares over the corners of boards."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.fisheye import solve_fisheye_rig
from stereokit.cameras.rig import Camera, Model, Rig
from stereokit.cameras.views import BoardView
from stereokit.errors import InputError
from stereokit.tables import counted

__all__ = ["COEFFICIENTS", "Solution", "solve_rig"]

COEFFICIENTS = {4: cv2.CALIB_FIX_K3, 5: 0, 8: cv2.CALIB_RATIONAL_MODEL}
"""How many a pinhole camera may have, and OpenCV's flag for it."""

_END = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-9)


@dataclass(frozen=True, eq=False)
class Solution:
    """A rig, and where the boards were.

    Attributes:
        rig: both cameras.
        rms: of the distances of all corners, in pixels.
        errors: (views, 2), the same of each view, left and right.
        turns: of each board, as a vector along the axis, in the axes of the left camera.
        places: of each board's first corner.
    """

    rig: Rig
    rms: float
    errors: npt.NDArray[np.float64]
    turns: list[npt.NDArray[np.float64]]
    places: list[npt.NDArray[np.float64]]


def solve_rig(views: Sequence[BoardView], size: tuple[int, int], model: Model, coefficients: int) -> Solution:
    """Solves for each camera alone, then for both together from there.

    Raises:
        InputError: views that can't be solved for, or cameras that make no rig.
    """
    try:
        return _solve_fisheye(views, size) if model == "fisheye" else _solve_pinhole(views, size, coefficients)
    except (cv2.error, np.linalg.LinAlgError) as error:
        reason = str(getattr(error, "err", error))[:80]
        raise InputError(
            f"calibrate: the {model} model can't be solved for on {counted(len(views), 'view')} ({reason}); take more "
            "views at different angles"
        ) from error


def _solve_pinhole(views: Sequence[BoardView], size: tuple[int, int], coefficients: int) -> Solution:
    places = [np.float32(view.object_points) for view in views]
    left, right = ([np.float32(getattr(view, side)) for view in views] for side in ("left", "right"))
    shape = size[1], size[0]
    flags = COEFFICIENTS[coefficients]
    alone: list[Any] = []
    for points in (left, right):
        _, matrix, lens, *_ = cv2.calibrateCamera(places, points, shape, None, None, flags=flags, criteria=_END)
        alone += [matrix, lens]
    rms, k1, d1, k2, d2, rotation, translation, _, _, turns, origins, errors = cv2.stereoCalibrateExtended(
        places,
        left,
        right,
        alone[0],
        alone[1],
        alone[2],
        alone[3],
        shape,
        np.eye(3),
        np.zeros((3, 1)),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=_END,
    )
    # without k3 OpenCV gives a zero for it
    cameras = [
        Camera(k[0, 0], k[1, 1], k[0, 2], k[1, 2], *shape, tuple(np.ravel(d)[:coefficients].tolist()))
        for k, d in ((k1, d1), (k2, d2))
    ]
    rig = Rig(cameras[0], cameras[1], tuple(np.ravel(rotation).tolist()), tuple(np.ravel(translation).tolist()))
    return Solution(rig, float(rms), np.asarray(errors, np.float64), _vectors(turns), _vectors(origins))


def _solve_fisheye(views: Sequence[BoardView], size: tuple[int, int]) -> Solution:
    rig, poses, residuals = solve_fisheye_rig(views, size)
    errors = [[float(np.sqrt(np.square(side).sum(axis=1).mean())) for side in pair] for pair in residuals]
    every = np.concatenate([side for pair in residuals for side in pair])
    rms = float(np.sqrt(np.square(every).sum(axis=1).mean()))
    return Solution(rig, rms, np.array(errors), _vectors(poses[:, :3]), _vectors(poses[:, 3:]))


def _vectors(values: Any) -> list[npt.NDArray[np.float64]]:
    return [np.asarray(value, np.float64).ravel() for value in values]
