"""What a rendered rig sees of a board: exact corners, or pictures."""

import numpy as np

from stereokit.cameras.rendering import board_plane, board_poses, example_rig
from stereokit.cameras.views import BoardView, find_board

SIZE = (480, 640)


def in_camera(rig, side, points):
    """Points of the left camera's axes in those of a camera of the rig."""
    return points if side == "left" else points @ np.reshape(rig.rotation, (3, 3)).T + np.array(rig.translation)


def placed(points, turn, centre):
    """Points of a board whose middle lies at `centre`, in the axes of the left camera."""
    return (points - points.mean(axis=0)) @ turn.T + centre


def project(rig, side, points):
    """Where a camera of the rig sees points of the left camera's axes."""
    return getattr(rig, side).project(in_camera(rig, side, points))


def inside(points, margin=5, size=SIZE):
    return ((points > margin) & (points < np.array(size[::-1]) - margin)).all(axis=1)


def exact_views(rig, board, count=45, noise=0.04, seed=0, size=SIZE, **where):
    """The corners of a board as a detector would give them."""
    rng = np.random.default_rng(seed)
    found = []
    for i, pose in enumerate(board_poses(count, seed=seed, **where)):
        points = [project(rig, side, placed(board.points, *pose)) for side in ("left", "right")]
        if all(inside(side, size=size).all() for side in points):
            noisy = [side + rng.normal(0, noise, side.shape) for side in points]
            found.append(BoardView(f"view {i}", board.points, *noisy))
    return found


def rendered_views(renderer, board, count, seed=0, **where):
    """What is found of a board in pictures of it."""
    return [
        find_board(board, *renderer([board_plane(board, *pose)], seed=seed + i), f"view {i}")
        for i, pose in enumerate(board_poses(count, seed=seed, **where))
    ]


def volume(rig, near=0.4, far=5.0, count=400, wide=0.6):
    """Points all over what both cameras see, as a view without noise."""
    rng = np.random.default_rng(5)
    depth = near * (far / near) ** rng.random(count)
    across = depth * rng.uniform(-1, 1, (2, count)) * np.array([[wide], [0.75 * wide]])
    points = np.concatenate([across, depth[None]]).T
    left, right = (project(rig, side, points) for side in ("left", "right"))
    seen = inside(left, 1) & inside(right, 1)
    return BoardView("volume", points[seen], left[seen], right[seen])


__all__ = ["SIZE", "exact_views", "example_rig", "in_camera", "inside", "placed", "project", "rendered_views", "volume"]
