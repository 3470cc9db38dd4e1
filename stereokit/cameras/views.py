"""Pairs of views that show a board."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.boards import Board, CharucoBoard
from stereokit.data.images import to_uint8
from stereokit.errors import InputError
from stereokit.tables import counted

__all__ = ["BoardView", "FoundViews", "ViewPair", "find_board", "find_views", "to_grey"]

_LEAST_CORNERS = 8
_LEAST_MODULE = 3.0  # px


class ViewPair(NamedTuple):
    """What both cameras took at one moment.

    Attributes:
        name: of the pair, for reports.
        left: (H, W, 3) RGB or (H, W) grey, uint8 or floating-point in [0, 1].
        right: likewise.
    """

    name: str
    left: npt.NDArray[Any]
    right: npt.NDArray[Any]


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
class FoundViews:
    """The views that show a board, and why the others do not.

    Attributes:
        board: as given, or a ChArUco board of the other layout, if only that fits.
        size: height and width of the images.
        views: that show it.
        unused: of the other pairs, by name, why not.
        warnings: what to do better.
    """

    board: Board
    size: tuple[int, int]
    views: tuple[BoardView, ...]
    unused: dict[str, str]
    warnings: tuple[str, ...]

    @property
    def reasons(self) -> str:
        """The reasons of `unused` with their counts, the most frequent first."""
        counts = Counter(self.unused.values()).most_common()
        return ", ".join(f"{count} x {reason}" for reason, count in counts)

    def check_enough(self, least: int) -> None:
        """Raises `InputError` for fewer views than `least`; the message counts the reasons."""
        if len(self.views) >= least:
            return
        looked = len(self.views) + len(self.unused)
        why = f" (not used: {self.reasons})" if self.unused else ""
        hints = "".join(f"; {warning}" for warning in self.warnings)
        raise InputError(
            f"calibrate: {len(self.views)} of {counted(looked, 'pair')} of views show the board{why}; expected at "
            f"least {least}, better 20 or more, at different distances and angles, all over both images{hints}"
        )


def find_views(board: Board, pairs: Callable[[], Iterable[ViewPair]]) -> FoundViews:
    """Finds a board in pairs of views.

    A ChArUco board that fewer than half of the pairs show is looked for in the other layout too, see
    `CharucoBoard.legacy`.

    Args:
        board: a `Checkerboard` or a `CharucoBoard`.
        pairs: gives them, from the beginning each time that it is called.

    Raises:
        InputError: no pairs, or images of more than one size.
    """
    found = _find(board, pairs())
    if isinstance(board, CharucoBoard) and board.rows % 2 == 0 and len(found.views) < len(found.unused):
        other = _find(replace(board, legacy=not board.legacy), pairs())
        if len(other.views) > len(found.views):
            layout = "from before OpenCV 4.6" if not board.legacy else "of OpenCV 4.6 and later"
            found = replace(other, warnings=(f"the board has the layout {layout}, and was found with it",))
    small = _small_markers(found.board, found.views)
    return found if small is None else replace(found, warnings=(*found.warnings, small))


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


def to_grey(image: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    """(H, W) of 8 bits, of an image in colour or grey.

    >>> to_grey(np.ones((2, 3, 3), np.float32)).tolist()
    [[255, 255, 255], [255, 255, 255]]
    """
    samples = to_uint8(image)
    return samples if samples.ndim == 2 else np.asarray(cv2.cvtColor(samples, cv2.COLOR_RGB2GRAY), np.uint8)


def _find(board: Board, pairs: Iterable[ViewPair]) -> FoundViews:
    size, first = None, ""
    views, unused = list[BoardView](), dict[str, str]()
    for pair in pairs:
        left, right = to_grey(pair.left), to_grey(pair.right)
        if size is None:
            size, first = left.shape, pair.name
        elif left.shape != size:
            raise InputError(
                f"pair {pair.name!r} has {left.shape[1]} x {left.shape[0]} pixels, pair {first!r} {size[1]} x {size[0]}"
                "; a camera is calibrated for one size"
            )
        found = find_board(board, left, right, pair.name)
        if isinstance(found, str):
            unused[pair.name] = found
        else:
            views.append(found)
    if size is None:
        raise InputError("calibrate: there are no views")
    return FoundViews(board, (size[0], size[1]), tuple(views), unused, ())


def _small_markers(board: Board, views: Iterable[BoardView]) -> str | None:
    """Why markers may be missed: their modules are smaller than 3 px in the median view."""
    if not isinstance(board, CharucoBoard):
        return None
    sides = []
    for view in views:
        # of a pixel, from neighbouring corners
        step = np.linalg.norm(np.diff(view.left, axis=0), axis=1)
        length = np.linalg.norm(np.diff(view.object_points, axis=0), axis=1)
        sides.append(float(np.median(step / length)) * board.marker / board.modules)
    if not sides or (module := float(np.median(sides))) >= _LEAST_MODULE:
        return None
    return (
        f"a module of the markers takes {module:.1f} px; use larger markers or come nearer, so that it takes 3 or more"
    )
