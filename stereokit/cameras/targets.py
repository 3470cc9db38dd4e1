"""What a board looks like: its dark rectangles, as a picture, and printed in true size."""

from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.boards import Board, CharucoBoard, Checkerboard

__all__ = ["board_picture", "board_size", "dark_rectangles", "draw_rectangles"]

Rectangles: TypeAlias = npt.NDArray[np.float64]


def board_size(board: Board) -> tuple[float, float]:
    """Width and height of a board in metres, without the white border that it needs around it.

    >>> board_size(Checkerboard(9, 6, 0.5))
    (5.0, 3.5)
    """
    columns, rows = _squares(board)
    return columns * board.square, rows * board.square


def dark_rectangles(board: Board) -> Rectangles:
    """(N, 4): left, top, width and height of all that is black, in metres from the board's upper left corner.

    The first inner corner lies at (square, square).
    """
    columns, rows = _squares(board)
    across, down = np.meshgrid(np.arange(columns), np.arange(rows))
    # the layout of ChArUco boards before OpenCV 4.6 begins with a white square where the rows are even
    first = 1 if isinstance(board, CharucoBoard) and board.legacy and rows % 2 == 0 else 0
    dark = (across + down) % 2 == first
    corners = np.stack([across[dark], down[dark]], axis=1) * board.square
    squares = np.concatenate([corners, np.full((len(corners), 2), board.square)], axis=1)
    return squares if isinstance(board, Checkerboard) else np.concatenate([squares, _modules(board)])


def board_picture(board: Board, per_metre: float, *, border: float = 0.0) -> npt.NDArray[np.uint8]:
    """A board in black and white; pixels that an edge passes through are grey by the part that is covered.

    Args:
        board: what to draw.
        per_metre: pixels.
        border: white, around the board, in metres.

    Returns:
        (H, W), whose pixel (row, column) covers (column, row) / per_metre to one more, from the border's corner.

    >>> board_picture(Checkerboard(3, 3, 0.01), 100).tolist()[0]
    [0, 255, 0, 255]
    """
    width, height = (side + 2 * border for side in board_size(board))
    shape = round(height * per_metre), round(width * per_metre)
    return draw_rectangles(dark_rectangles(board) + np.array([border, border, 0, 0]), per_metre, shape)


def draw_rectangles(rectangles: Rectangles, per_metre: float, shape: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """Rectangles in black on white, see `board_picture`.

    Args:
        rectangles: (N, 4), left, top, width and height in metres.
        per_metre: pixels.
        shape: rows and columns.
    """
    ink = np.zeros(shape, np.float32)
    for left, top, across, down in rectangles * per_metre:
        rows, row_cover = _covered(top, top + down, shape[0])
        columns, column_cover = _covered(left, left + across, shape[1])
        ink[rows, columns] += np.outer(row_cover, column_cover)
    return np.rint(255 * (1 - np.clip(ink, 0, 1))).astype(np.uint8)


def _squares(board: Board) -> tuple[int, int]:
    more = 1 if isinstance(board, Checkerboard) else 0
    return board.columns + more, board.rows + more


def _modules(board: CharucoBoard) -> Rectangles:
    """The black modules of all markers."""
    pattern = board.opencv()
    dictionary, side = pattern.getDictionary(), board.modules
    module = board.marker / side
    found = []
    for number, corners in zip(np.ravel(pattern.getIds()), pattern.getObjPoints(), strict=True):
        rows, columns = np.nonzero(cv2.aruco.generateImageMarker(dictionary, int(number), side) == 0)
        origin = np.asarray(corners).reshape(-1, 3)[:, :2].min(axis=0)
        places = origin + np.stack([columns, rows], axis=1) * module
        found.append(np.concatenate([places, np.full((len(places), 2), module)], axis=1))
    return np.concatenate(found)


def _covered(start: float, end: float, count: int) -> tuple[slice, npt.NDArray[np.float64]]:
    """The pixels that an interval touches, and the part of each that it covers."""
    first, last = max(int(np.floor(start + 1e-9)), 0), min(int(np.ceil(end - 1e-9)), count)
    edges = np.arange(first, last)
    return slice(first, last), np.clip(np.minimum(edges + 1, end) - np.maximum(edges, start), 0, 1)
