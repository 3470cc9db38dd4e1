"""Targets for calibration, and where a view shows them."""

from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.errors import InputError

__all__ = ["Board", "CharucoBoard", "Checkerboard", "Corners"]

Grey: TypeAlias = npt.NDArray[np.uint8]
Points: TypeAlias = npt.NDArray[np.float64]

_LARGEST_WINDOW = 5  # half of 11 px
_END = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)


class Corners(NamedTuple):
    """Corners of a board in one view: their numbers on the board, and (N, 2) column and row."""

    ids: npt.NDArray[np.intp]
    points: Points


@dataclass(frozen=True)
class Checkerboard:
    """A board of black and white squares.

    Attributes:
        columns: of inner corners, where four squares meet: one less than squares.
        rows: likewise.
        square: side of a square in metres.

    Raises:
        InputError: fewer than 3 columns or rows, or a side that is not from 1 mm to 2 m, as when the unit was missed.
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        _check(self.columns, self.rows, self.square)

    @property
    def points(self) -> Points:
        """(N, 3), the corners on the board in metres, row by row."""
        return _grid(self.columns, self.rows, self.square)

    def find(self, grey: Grey) -> Corners | None:
        """All corners of the board in a view to about 0.05 px, or None where it is not wholly seen.

        Source: OpenCV's `findChessboardCorners` and `cornerSubPix`; `findChessboardCornersSB` where these fail.
        """
        shape = self.columns, self.rows
        found, points = cv2.findChessboardCorners(
            grey, shape, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
        )
        if found:
            grid = np.asarray(points, np.float32).reshape(self.rows, self.columns, 2)
            spacing = min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1))
            # a window that reaches a neighbour is drawn to it
            half = int(np.clip((spacing - 1) / 2, 2, _LARGEST_WINDOW))
            points = cv2.cornerSubPix(grey, grid.reshape(-1, 1, 2), (half, half), (-1, -1), _END)
        else:
            found, points = cv2.findChessboardCornersSB(grey, shape)
            if not found:
                return None
        return Corners(np.arange(self.columns * self.rows), np.asarray(points, np.float64).reshape(-1, 2))

    def paired(self, left: Corners, right: Corners) -> tuple[Corners, Corners]:
        """The corners in one order. A board may look alike turned around, so each view alone can't tell."""
        grid = right.points.reshape(self.rows, self.columns, 2)
        turns = range(4) if self.rows == self.columns else (0, 2)
        candidates = [np.rot90(grid, turn).reshape(-1, 2) for turn in turns]
        shape = left.points - left.points.mean(axis=0)
        best = min(candidates, key=lambda points: float(np.square(points - points.mean(axis=0) - shape).sum()))
        return left, Corners(right.ids, best)


@dataclass(frozen=True)
class CharucoBoard:
    """A checkerboard whose white squares hold markers, so that it need not be seen wholly.

    Attributes:
        columns: of squares.
        rows: of squares.
        square: side of a square in metres.
        marker: side of a marker in metres.
        dictionary: of the markers, a name of OpenCV such as "DICT_5X5_100".
        legacy: the layout of OpenCV before 4.6, which differs for an even number of rows.

    Raises:
        InputError: an unknown dictionary, a marker that is not smaller than its square, or as `Checkerboard`.
    """

    columns: int
    rows: int
    square: float
    marker: float
    dictionary: str = "DICT_5X5_100"
    legacy: bool = False

    def __post_init__(self) -> None:
        _check(self.columns - 1, self.rows - 1, self.square)
        if not 0 < self.marker < self.square:
            raise InputError(f"board: a marker is smaller than its square, got {self.marker} and {self.square} m")
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            raise InputError(f"board: unknown dictionary {self.dictionary[:40]!r}; use a name such as 'DICT_5X5_100'")
        there, needed = len(self._dictionary().bytesList), self.columns * self.rows // 2
        if there < needed:
            raise InputError(f"board: {needed} markers are needed, {self.dictionary} has {there}; use a larger one")

    @property
    def points(self) -> Points:
        """(N, 3), the corners on the board in metres, row by row."""
        return _grid(self.columns - 1, self.rows - 1, self.square)

    @property
    def modules(self) -> int:
        """How many modules a marker has along its side, with its border."""
        return int(self._dictionary().markerSize) + 2

    def find(self, grey: Grey) -> Corners | None:
        """The corners of the board that a view shows, or None where it shows none."""
        points, ids, *_ = cv2.aruco.CharucoDetector(self.opencv()).detectBoard(grey)
        if ids is None or points is None or len(ids) == 0:
            return None
        return Corners(np.asarray(ids).ravel().astype(np.intp), np.asarray(points, np.float64).reshape(-1, 2))

    def paired(self, left: Corners, right: Corners) -> tuple[Corners, Corners]:
        """The corners that both views show, in one order."""
        _, first, second = np.intersect1d(left.ids, right.ids, return_indices=True)
        return Corners(left.ids[first], left.points[first]), Corners(right.ids[second], right.points[second])

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """The board for OpenCV's functions."""
        shape = self.columns, self.rows
        board = cv2.aruco.CharucoBoard(shape, self.square, self.marker, self._dictionary())
        board.setLegacyPattern(self.legacy)
        return board

    def _dictionary(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))


Board: TypeAlias = "Checkerboard | CharucoBoard"


def _check(columns: int, rows: int, square: float) -> None:
    if columns < 3 or rows < 3:
        raise InputError(f"board: expected at least 3 x 3 inner corners, got {columns} x {rows}")
    if not 0.001 <= square <= 2:
        raise InputError(
            f"board: the side of a square is {square} m; expected 0.001 to 2, in metres: 0.03 for squares of 30 mm"
        )


def _grid(columns: int, rows: int, square: float) -> Points:
    y, x = np.mgrid[:rows, :columns]
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3) * square
