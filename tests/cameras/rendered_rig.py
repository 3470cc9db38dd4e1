"""A rig of two cameras whose geometry is known, and what it sees of a board: exact corners, or rendered images."""

from functools import cache

import cv2
import numpy as np

from stereokit.cameras.rig import Camera, Rig

SIZE = (480, 640)


def rotation(*angles):
    return cv2.Rodrigues(np.radians(np.array(angles, float)))[0]


def rig(model="pinhole", baseline=0.06):
    """As in a rig of small cameras: 640 x 480, f = 520 px, a little distorted and out of line."""
    if model == "fisheye":
        lens = (0.02, -0.01, 0.004, -0.001)
        left, right = ((300.0, 301.0, 322.0, 238.0), (302.0, 303.0, 318.0, 242.0))
    else:
        lens = (-0.12, 0.05, 4e-4, -3e-4)
        left, right = ((520.0, 521.0, 323.0, 237.0), (522.0, 523.0, 316.0, 243.0))
    turn = rotation(0.6, -0.8, 0.5)
    move = -turn @ np.array([baseline, 0.001, -0.0008])
    height, width = SIZE
    return Rig(
        Camera(*left, width, height, lens, model),
        Camera(*right, width, height, lens, model),
        tuple(turn.ravel().tolist()),
        tuple(move.tolist()),
    )


def poses(count, seed=0, near=0.35, far=1.0, tilt=35.0, wide=0.75):
    """Turn and place of a board before the left camera: all over the image, near and far, tilted every way."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        distance = near * (far / near) ** ((i % 5) / 4)
        across, down = (i * 0.618 % 1 - 0.5), (i * 0.755 % 1 - 0.5)
        centre = distance * np.array([across * wide, down * 0.75 * wide, 1.0])
        yield rotation(*rng.uniform(-tilt, tilt, 2), rng.uniform(-15, 15)), centre


def to_camera(rig, side, turn, centre):
    """The board's turn and place in a camera of the rig."""
    if side == "left":
        return turn, centre
    other = np.reshape(rig.rotation, (3, 3))
    return other @ turn, other @ centre + np.array(rig.translation)


def project(camera, points, turn, centre):
    """Where a camera sees points of a board whose middle lies at `centre`."""
    module = cv2.fisheye if camera.model == "fisheye" else cv2
    placed = (points - points.mean(axis=0)).reshape(-1, 1, 3)
    angle = cv2.Rodrigues(turn)[0]
    return module.projectPoints(placed, angle, centre.reshape(3, 1), camera.matrix, camera.coefficients)[0].reshape(
        -1, 2
    )


def inside(points, margin=5):
    height, width = SIZE
    return ((points > margin) & (points < np.array([width, height]) - margin)).all(axis=1)


@cache
def rays(of, side, samples=3):
    """Directions (H s, W s, 3) of s x s samples in each pixel of a camera."""
    camera = getattr(of, side)
    height, width = SIZE
    x = (np.arange(width * samples) + 0.5) / samples - 0.5
    y = (np.arange(height * samples) + 0.5) / samples - 0.5
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 1, 2)
    module = cv2.fisheye if camera.model == "fisheye" else cv2
    found = module.undistortPoints(grid, camera.matrix, camera.coefficients).reshape(len(y), len(x), 2)
    return np.concatenate([found, np.ones((*found.shape[:2], 1))], axis=2)


def render(directions, texture, per_metre, turn, centre, rng, noise=2.0, blur=0.6, samples=3):
    """What a camera sees of a board: `texture` in the plane z = 0, its middle at `centre`, grey behind it.

    Args:
        directions: of `rays`.
        texture: (h, w) uint8.
        per_metre: pixels of the texture.
        turn: of the board.
        centre: of the board.
        rng: of the noise.
    """
    normal = turn[:, 2]
    depth = (normal @ centre) / (directions @ normal)
    on_board = (directions * depth[:, :, None] - centre) @ turn
    height, width = texture.shape
    columns = (on_board[:, :, 0] * per_metre + (width - 1) / 2).astype(np.float32)
    rows = (on_board[:, :, 1] * per_metre + (height - 1) / 2).astype(np.float32)
    seen = cv2.remap(texture, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(110,))
    image = seen.reshape(SIZE[0], samples, SIZE[1], samples).astype(np.float32).mean(axis=(1, 3))
    image = cv2.GaussianBlur(image, (0, 0), blur) + rng.normal(0, noise, SIZE)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def checkerboard_texture(board, per_square=40):
    """Black and white squares with a white border of one square, and pixels per metre."""
    squares = np.indices((board.rows + 1, board.columns + 1)).sum(axis=0) % 2
    squares = np.pad(np.where(squares == 0, 20, 235), 1, constant_values=235).astype(np.uint8)
    return np.kron(squares, np.ones((per_square, per_square), np.uint8)), per_square / board.square


def charuco_texture(board, per_square=60):
    """The board as OpenCV draws it, with a white border of one square, and pixels per metre."""
    size = board.columns * per_square, board.rows * per_square
    image = board.opencv().generateImage(size, marginSize=0)
    return np.pad(image, per_square, constant_values=255), per_square / board.square
