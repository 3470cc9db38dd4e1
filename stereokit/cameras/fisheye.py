"""Two fisheye cameras by least squares over the corners of boards, of which each view may show another part.

OpenCV's `fisheye.stereoCalibrate` takes views of one number of corners alone, and asserts on corners far off the axis.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.rig import Camera, Rig
from stereokit.cameras.views import BoardView
from stereokit.errors import InputError

__all__ = ["solve_fisheye_rig"]

Array: TypeAlias = npt.NDArray[np.float64]
Block: TypeAlias = tuple[Array, Array, Array]
"""Of a view: residuals (R,), and their derivatives by what all views share (R, S) and by the board's pose (R, 6)."""

_LENS = 8  # fx fy cx cy k1 k2 k3 k4
_FIELDS_OF_VIEW = (60, 90, 120, 150, 180)  # in degrees, of which the best begins
_FARTHEST = 5.0  # tangent of the angle up to which corners tell where a board is at the beginning
_STEPS = 100
_SMALLEST_STEP = 1e-10  # of the cost
_MOST_RMS = 5.0  # px


def solve_fisheye_rig(
    views: Sequence[BoardView], size: tuple[int, int]
) -> tuple[Rig, Array, list[tuple[Array, Array]]]:
    """Solves for each camera alone, then for both together.

    Args:
        views: of the board.
        size: height and width of the images.

    Returns:
        The rig; the pose of each board in the left camera, (views, 6), turn and place; and for each view where the rig
        puts the corners less where they are, (N, 2) left and right.

    Raises:
        InputError: no sensible cameras fit.

    Source: J. Kannala and S. Brandt, A generic camera model and calibration method, 2006; K. Levenberg, 1944, and D.
    Marquardt, 1963; poses are eliminated as in B. Triggs et al., Bundle adjustment: a modern synthesis, 2000.
    """
    lenses, poses = list[Array](), list[Array]()
    for side in ("left", "right"):
        points = [getattr(view, side) for view in views]
        lens, pose = _start(views, points, size)
        lens, pose = _least_squares(_of_camera(views, points), lens, pose)
        lenses.append(lens)
        poses.append(pose)
    shared = np.concatenate([*lenses, _between(poses[0], poses[1])])
    shared, pose = _least_squares(_of_rig(views), shared, poses[0])
    residuals = [_sides(block[0]) for block in _of_rig(views)(shared, pose)]
    every = np.concatenate([side for pair in residuals for side in pair])
    rms = float(np.sqrt(np.square(every).sum(axis=1).mean()))
    cameras = [_camera(shared[i * _LENS : (i + 1) * _LENS], size) for i in (0, 1)]
    for side, camera in zip(("left", "right"), cameras, strict=True):
        _check(camera, np.concatenate([getattr(view, side) for view in views]), side, rms)
    rotation = cv2.Rodrigues(shared[2 * _LENS : 2 * _LENS + 3])[0]
    rig = Rig(cameras[0], cameras[1], tuple(rotation.ravel().tolist()), tuple(shared[-3:].tolist()))
    return rig, pose, residuals


def _start(views: Sequence[BoardView], points: Sequence[Array], size: tuple[int, int]) -> tuple[Array, Array]:
    """A lens without distortion, and where the boards are; of several fields of view the one that fits best."""
    found = list[tuple[float, Array, Array]]()
    for degrees in _FIELDS_OF_VIEW:
        focal = size[1] / np.radians(degrees)
        lens = np.array([focal, focal, (size[1] - 1) / 2, (size[0] - 1) / 2, 0, 0, 0, 0])
        camera = _camera(lens, size)
        poses = np.array([_pose(camera, view.object_points, seen) for view, seen in zip(views, points, strict=True)])
        found.append((_cost(_of_camera(views, points)(lens, poses)), lens, poses))
    _, lens, poses = min(found, key=lambda one: one[0])
    return lens, poses


def _pose(camera: Camera, places: Array, points: Array) -> Array:
    """Turn and place of a board that a camera sees."""
    rays = camera.rays(points)[:, :2]
    near = (np.abs(rays) < _FARTHEST).all(axis=1)
    if near.sum() < 6:
        raise InputError("calibrate: a view shows the board only at the edge of a fisheye image; leave such views out")
    _, turn, place = cv2.solvePnP(
        places[near], np.ascontiguousarray(rays[near]), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    return np.concatenate([turn.ravel(), place.ravel()])


def _between(left: Array, right: Array) -> Array:
    """Turn and place of the left camera in the right one, from boards' poses in both."""
    moves = [
        np.concatenate([part.ravel() for part in cv2.composeRT(*_inverse(first), second[:3], second[3:])[:2]])
        for first, second in zip(left, right, strict=True)
    ]
    middle: Array = np.median(moves, axis=0)
    return middle


def _inverse(pose: Array) -> tuple[Array, Array]:
    return -pose[:3], -cv2.Rodrigues(pose[:3])[0].T @ pose[3:]


def _of_camera(views: Sequence[BoardView], points: Sequence[Array]) -> "_Problem":
    """The least squares of one camera, which share its lens."""

    def blocks(lens: Array, poses: Array) -> list[Block]:
        found = []
        for view, seen, pose in zip(views, points, poses, strict=True):
            residuals, by_lens, by_pose = _projected(lens, view.object_points, seen, pose[:3], pose[3:])
            found.append((residuals, by_lens, by_pose))
        return found

    return blocks


def _of_rig(views: Sequence[BoardView]) -> "_Problem":
    """The least squares of both cameras, which share two lenses and the pose between them."""

    def blocks(shared: Array, poses: Array) -> list[Block]:
        first, second, turn, move = np.split(shared, [_LENS, 2 * _LENS, 2 * _LENS + 3])
        found = []
        for view, pose in zip(views, poses, strict=True):
            left, left_by_lens, left_by_pose = _projected(first, view.object_points, view.left, pose[:3], pose[3:])
            # the board in the right camera, and its derivatives
            composed = cv2.composeRT(pose[:3], pose[3:], turn, move)
            turned, moved, *by = (np.asarray(part, np.float64) for part in composed)
            right, right_by_lens, right_by_own = _projected(second, view.object_points, view.right, turned, moved)
            by_pose, by_move = np.block([[by[0], by[1]], [by[4], by[5]]]), np.block([[by[2], by[3]], [by[6], by[7]]])
            nothing = np.zeros_like(left_by_lens)
            by_shared = np.block(
                [
                    [left_by_lens, nothing, np.zeros((len(left), 6))],
                    [nothing, right_by_lens, right_by_own @ by_move],
                ]
            )
            by_board = np.concatenate([left_by_pose, right_by_own @ by_pose])
            found.append((np.concatenate([left, right]), by_shared, by_board))
        return found

    return blocks


def _projected(lens: Array, places: Array, points: Array, turn: Array, place: Array) -> Block:
    """Where a lens shows a board less where it is seen, with the derivatives by the lens and by the pose."""
    matrix = np.array([[lens[0], 0, lens[2]], [0, lens[1], lens[3]], [0, 0, 1]])
    given = places.reshape(-1, 1, 3), turn.reshape(1, 1, 3), place.reshape(1, 1, 3), matrix, lens[4:]
    seen, by = (np.asarray(part, np.float64) for part in cv2.fisheye.projectPoints(*given))
    return (seen.reshape(-1, 2) - points).ravel(), by[:, :_LENS], by[:, _LENS : _LENS + 6]


_Problem: TypeAlias = Callable[[Array, Array], "list[Block]"]


def _least_squares(problem: _Problem, shared: Array, poses: Array) -> tuple[Array, Array]:
    """Levenberg's and Marquardt's method, where each pose takes part in the residuals of its own view alone."""
    blocks, damping = problem(shared, poses), 1e-3
    cost = _cost(blocks)
    for _ in range(_STEPS):
        step_shared, step_poses = _step(blocks, damping)
        tried = problem(shared + step_shared, poses + step_poses)
        new = _cost(tried)
        if not new < cost:
            damping *= 10
            if damping > 1e8:
                break
            continue
        shared, poses, blocks = shared + step_shared, poses + step_poses, tried
        gain, cost, damping = cost - new, new, max(damping / 10, 1e-12)
        if gain <= _SMALLEST_STEP * cost:
            break
    return shared, poses


def _step(blocks: Sequence[Block], damping: float) -> tuple[Array, Array]:
    """The step of the damped normal equations: first of what is shared, then of each pose."""
    count = blocks[0][1].shape[1]
    normal, gradient = np.zeros((count, count)), np.zeros(count)
    own = list[tuple[Array, Array, Array]]()
    for residuals, by_shared, by_pose in blocks:
        normal += by_shared.T @ by_shared
        gradient += by_shared.T @ residuals
        own.append((_damped(by_pose.T @ by_pose, damping), by_shared.T @ by_pose, by_pose.T @ residuals))
    normal = _damped(normal, damping)
    for square, mixed, slope in own:
        solved = np.linalg.solve(square, np.column_stack([mixed.T, slope]))
        normal -= mixed @ solved[:, :-1]
        gradient -= mixed @ solved[:, -1]
    # focal lengths are hundreds and coefficients hundredths
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-30))
    step = -scale * np.linalg.solve(normal * np.outer(scale, scale), scale * gradient)
    poses = [-np.linalg.solve(square, slope + mixed.T @ step) for square, mixed, slope in own]
    return step, np.array(poses)


def _damped(square: Array, damping: float) -> Array:
    return square + damping * np.diag(np.diag(square))


def _cost(blocks: Sequence[Block]) -> float:
    total = sum(float(residuals @ residuals) for residuals, _, _ in blocks)
    return total if np.isfinite(total) else float("inf")


def _sides(residuals: Array) -> tuple[Array, Array]:
    left, right = residuals.reshape(2, -1, 2)
    return left, right


def _camera(lens: Array, size: tuple[int, int]) -> Camera:
    fx, fy, cx, cy, *distortion = lens.tolist()
    return Camera(fx, fy, cx, cy, size[1], size[0], tuple(distortion), "fisheye")


def _check(camera: Camera, points: Array, side: str, rms: float) -> None:
    """Whether a lens makes sense: near the middle, going outwards to the farthest corner seen, with small errors."""
    rays = camera.rays(points)
    angles = np.linspace(0, np.arctan(np.linalg.norm(rays[:, :2], axis=1).max()), 50)
    k = camera.distortion
    slope = np.ones_like(angles) + sum((2 * i + 3) * k[i] * angles ** (2 * i + 2) for i in range(4))
    middle = 0 < camera.cx < camera.width and 0 < camera.cy < camera.height
    if not (middle and (slope > 0).all() and rms < _MOST_RMS):
        raise InputError(
            f"calibrate: the fisheye model found for the {side} camera makes no sense (error {rms:.2g} px, focal "
            f"length {camera.fx:.0f} px, centre at ({camera.cx:.0f}, {camera.cy:.0f})); show the board all over the "
            "images, nearer and at more angles, or try the pinhole model"
        )
