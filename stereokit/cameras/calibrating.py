"""A rig out of views of a board: solved, rid of poor views, and judged on views held out."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.boards import Board, Checkerboard
from stereokit.cameras.calibration_quality import Quality, cautions, coverage, epipolar_rms, spread
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rig import Camera, Model, Rig
from stereokit.errors import InputError
from stereokit.tables import counted

__all__ = ["BoardView", "RigCalibration", "calibrate_rig", "find_board"]

_LEAST_CORNERS = 8
_HELD_OUT = 5  # every fifth view
_END = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-9)
_FLAGS = {4: cv2.CALIB_FIX_K3, 5: 0, 8: cv2.CALIB_RATIONAL_MODEL}


@dataclass(frozen=True, eq=False)
class BoardView:
    """A pair of views that both show the board.

    Attributes:
        name: of the pair.
        object_points: (N, 3), places on the board in metres.
        left: (N, 2), where the left view shows them.
        right: (N, 2), where the right view shows them.
    """

    name: str
    object_points: npt.NDArray[np.float64]
    left: npt.NDArray[np.float64]
    right: npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """A rig and how good it is.

    Attributes:
        rig: the two cameras.
        quality: errors and coverage.
        view_errors: rms error of each view that was used, in pixels, left and right, by name.
        rejected: names of the views that were left out because of their errors, the worst first.
        warnings: what may be wrong, and what to do.
    """

    rig: Rig
    quality: Quality
    view_errors: dict[str, tuple[float, float]]
    rejected: tuple[str, ...]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Errors and warnings as plain values, which `Rig.write` keeps as `about`."""
        errors = {name: list(values) for name, values in self.view_errors.items()}
        return {
            "quality": self.quality.to_dict(),
            "view_errors": errors,
            "rejected": list(self.rejected),
            "warnings": list(self.warnings),
        }


@dataclass(frozen=True, eq=False)
class _Solution:
    rig: Rig
    rms: float
    errors: npt.NDArray[np.float64]
    """(views, 2)"""
    turns: list[npt.NDArray[np.float64]]
    places: list[npt.NDArray[np.float64]]


def find_board(board: Board, left: npt.NDArray[np.uint8], right: npt.NDArray[np.uint8], name: str) -> BoardView | str:
    """Finds the board in a pair of views.

    Args:
        board: a `Checkerboard` or a `CharucoBoard`.
        left: (H, W) grey.
        right: of the same size.
        name: of the pair, for reports.

    Returns:
        The view, or in words why it can't be used.

    Raises:
        InputError: views of two sizes.
    """
    if left.shape != right.shape:
        raise InputError(
            f"pair {name!r}: the left view has {left.shape[1]} x {left.shape[0]} pixels, the right one "
            f"{right.shape[1]} x {right.shape[0]}; expected one size"
        )
    found = board.find(left), board.find(right)
    if found[0] is None or found[1] is None:
        missing = " nor the ".join(side for side, corners in zip(("left", "right"), found, strict=True) if not corners)
        return f"no board in the {missing} view"
    first, second = board.paired(found[0], found[1])
    if len(first.ids) < _LEAST_CORNERS:
        return f"fewer than {_LEAST_CORNERS} corners are seen in both views"
    places = board.points[first.ids]
    if np.linalg.matrix_rank(places[:, :2] - places[0, :2], tol=1e-6) < 2:
        return "the corners seen in both views lie in a line"
    return BoardView(name, places, first.points, second.points)


def calibrate_rig(
    views: Sequence[BoardView],
    size: tuple[int, int],
    *,
    model: Model = "pinhole",
    coefficients: int = 4,
    least_views: int = 8,
) -> RigCalibration:
    """Solves for both cameras and how they stand.

    Each camera is solved alone, then both together from there. Views whose error in the joint solution stands out are
    left out, the worst first, with a new solution after each; a poor match of the two views does not show in one camera
    alone. Every fifth of the views kept is then left out of one more solution, and measures it.

    Args:
        views: that show the board, see `find_board`.
        size: height and width of the images.
        model: "pinhole" or "fisheye".
        coefficients: of distortion for pinhole cameras: 4 (k1 k2 p1 p2), 5 (k3 too) or 8 (rational). More of them go
            astray where the board never was.
        least_views: to be kept.

    Raises:
        InputError: too few views, cameras that make no rig (swapped, one above the other, a baseline outside of 5 mm to
            5 m), or views that can't be solved for.

    Source: Z. Zhang, A flexible new technique for camera calibration, 2000; OpenCV's `stereoCalibrate`.
    """
    if coefficients not in _FLAGS:
        raise InputError(f"calibrate: pinhole cameras have 4, 5 or 8 coefficients, got {coefficients}")
    if len(views) < least_views:
        raise InputError(
            f"calibrate: {counted(len(views), 'view')} of the board; expected at least {least_views}, better 20 or "
            "more, at "
            "different distances and angles, all over both images"
        )
    kept, rejected = list(views), list[str]()
    solution = _solve(kept, size, model, coefficients)
    while len(kept) > least_views and (worst := _outlier(solution.errors)) is not None:
        rejected.append(kept.pop(worst).name)
        solution = _solve(kept, size, model, coefficients)
    used = [view for i, view in enumerate(kept) if i % _HELD_OUT != _HELD_OUT - 1]
    held_out = kept[_HELD_OUT - 1 :: _HELD_OUT]
    measured = _solve(used, size, model, coefficients).rig if len(used) >= least_views // 2 else solution.rig
    tilt, distances = spread(solution.turns, solution.places)
    quality = Quality(
        views=len(kept),
        rms=solution.rms,
        epipolar_rms=epipolar_rms(rectify(solution.rig), solution.rig, kept),
        held_out_rms=epipolar_rms(rectify(measured), measured, held_out),
        left_coverage=coverage([view.left for view in kept], size),
        right_coverage=coverage([view.right for view in kept], size),
        tilt=tilt,
        distances=distances,
    )
    errors = {view.name: (float(a), float(b)) for view, (a, b) in zip(kept, solution.errors, strict=True)}
    return RigCalibration(
        solution.rig, quality, errors, tuple(rejected), cautions(quality, solution.rig, len(views), len(rejected))
    )


def marker_warning(board: Board, views: Sequence[BoardView]) -> str | None:
    """Why markers may be missed: their modules are smaller than 3 px in the median view."""
    if isinstance(board, Checkerboard) or not views:
        return None
    sides = []
    for view in views:
        step = np.linalg.norm(np.diff(view.left, axis=0), axis=1) / np.linalg.norm(
            np.diff(view.object_points, axis=0), axis=1
        )
        sides.append(float(np.median(step)) * board.marker / board.modules)
    module = float(np.median(sides))
    if module >= 3:
        return None
    return (
        f"a module of the markers takes {module:.1f} px; use larger markers or come nearer, so that it takes 3 or more"
    )


def _outlier(errors: npt.NDArray[np.float64]) -> int | None:
    """The view of the largest error, if that stands out."""
    worst = errors.max(axis=1)
    middle = float(np.median(worst))
    deviation = 1.4826 * float(np.median(np.abs(worst - middle)))
    return int(worst.argmax()) if worst.max() > max(middle + 4 * deviation, 2 * middle) else None


def _solve(views: Sequence[BoardView], size: tuple[int, int], model: Model, coefficients: int) -> _Solution:
    try:
        return (_solve_fisheye if model == "fisheye" else _solve_pinhole)(views, size, coefficients)
    except cv2.error as error:
        raise InputError(
            f"calibrate: the {model} model can't be solved for on {counted(len(views), 'view')} "
            f"({str(error.err)[:80]}); take more views at different angles"
        ) from error


def _solve_pinhole(views: Sequence[BoardView], size: tuple[int, int], coefficients: int) -> _Solution:
    places, left, right = ([np.float32(part) for part in parts] for parts in _parts(views))
    shape = size[1], size[0]
    flags = _FLAGS[coefficients]
    first, second = (
        cv2.calibrateCamera(places, points, shape, None, None, flags=flags, criteria=_END)[1:3]
        for points in (left, right)
    )
    rms, k1, d1, k2, d2, rotation, translation, _, _, turns, origins, errors = cv2.stereoCalibrateExtended(
        places,
        left,
        right,
        first[0],
        first[1],
        second[0],
        second[1],
        shape,
        np.eye(3),
        np.zeros((3, 1)),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=_END,
    )
    # without k3 OpenCV gives a zero for it
    cameras = [_camera(k, np.ravel(d)[:coefficients], size, "pinhole") for k, d in ((k1, d1), (k2, d2))]
    return _Solution(
        _rig(cameras, rotation, translation),
        rms,
        np.asarray(errors, np.float64),
        [np.asarray(turn) for turn in turns],
        [np.asarray(place) for place in origins],
    )


def _solve_fisheye(views: Sequence[BoardView], size: tuple[int, int], coefficients: int) -> _Solution:
    del coefficients  # always four
    if len({len(view.left) for view in views}) > 1:
        raise InputError(
            "calibrate: OpenCV's fisheye model takes views of one number of corners; use a checkerboard that each view "
            "shows wholly"
        )
    places, left, right = ([part.reshape(1, -1, part.shape[1]) for part in parts] for parts in _parts(views))
    shape = size[1], size[0]
    flags = _fisheye_flags("RECOMPUTE_EXTRINSIC", "FIX_SKEW", "USE_INTRINSIC_GUESS")
    guess = np.array([[size[1] / np.pi, 0, (size[1] - 1) / 2], [0, size[1] / np.pi, (size[0] - 1) / 2], [0, 0, 1]])
    cameras: list[Any] = []
    for points in (left, right):
        _, matrix, lens, *_ = cv2.fisheye.calibrate(
            places, points, shape, guess.copy(), np.zeros((4, 1)), flags=flags, criteria=_END
        )
        cameras += [matrix, lens]
    rms, k1, d1, k2, d2, rotation, translation, *_ = cv2.fisheye.stereoCalibrate(
        places, left, right, cameras[0], cameras[1], cameras[2], cameras[3], shape, flags=flags, criteria=_END
    )
    pair = [_camera(k, np.ravel(d), size, "fisheye") for k, d in ((k1, d1), (k2, d2))]
    rig = _rig(pair, rotation, translation)
    errors, turns, origins = _fisheye_errors(views, rig)
    return _Solution(rig, rms, errors, turns, origins)


def _fisheye_flags(*names: str) -> int:
    """Flags that stand in `cv2.fisheye` before OpenCV 5 and in `cv2` from then on, with other values."""
    return sum(int(getattr(cv2.fisheye, f"CALIB_{name}", None) or getattr(cv2, f"CALIB_{name}")) for name in names)


def _fisheye_errors(
    views: Sequence[BoardView], rig: Rig
) -> tuple[npt.NDArray[np.float64], list[npt.NDArray[np.float64]], list[npt.NDArray[np.float64]]]:
    """The errors of each view in both cameras, its pose being that which the left view shows."""
    errors, turns, origins = [], list[Any](), list[Any]()
    rotation = np.reshape(rig.rotation, (3, 3))
    for view in views:
        rays = cv2.fisheye.undistortPoints(view.left.reshape(-1, 1, 2), rig.left.matrix, rig.left.coefficients)
        _, turn, origin = cv2.solvePnP(view.object_points, rays, np.eye(3), None)
        turned = rotation @ cv2.Rodrigues(turn)[0]
        moved = rotation @ origin + np.reshape(rig.translation, (3, 1))
        places = view.object_points.reshape(-1, 1, 3)
        pair = []
        for camera, points, angle, place in (
            (rig.left, view.left, turn, origin),
            (rig.right, view.right, cv2.Rodrigues(turned)[0], moved),
        ):
            projected, _ = cv2.fisheye.projectPoints(places, angle, place, camera.matrix, camera.coefficients)
            seen = np.asarray(projected).reshape(-1, 2)
            pair.append(float(np.sqrt(np.square(seen - points).sum(axis=1).mean())))
        errors.append(pair)
        turns.append(turn)
        origins.append(origin)
    return np.array(errors), turns, origins


def _parts(views: Sequence[BoardView]) -> tuple[list[Any], list[Any], list[Any]]:
    return [view.object_points for view in views], [view.left for view in views], [view.right for view in views]


def _camera(matrix: Any, distortion: Any, size: tuple[int, int], model: Model) -> Camera:
    fx, fy, cx, cy = (float(matrix[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(fx, fy, cx, cy, size[1], size[0], tuple(float(value) for value in distortion), model)


def _rig(cameras: list[Camera], rotation: Any, translation: Any) -> Rig:
    turn, move = (tuple(float(value) for value in np.ravel(values)) for values in (rotation, translation))
    return Rig(cameras[0], cameras[1], turn, move)
