"""How good the calibration of a rig is, and what to do about it."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.rectification import Rectification
from stereokit.cameras.rig import Camera, Rig
from stereokit.cameras.solving import Solution
from stereokit.cameras.views import BoardView

__all__ = [
    "LIMITS",
    "Quality",
    "ViewQuality",
    "cautions",
    "coverage",
    "epipolar_rms",
    "largest_tilt",
    "rectified_points",
    "share_covered",
    "view_quality",
]

_CELLS = (6, 8)  # rows and columns


class Limits(NamedTuple):
    """Beyond which a calibration is warned of."""

    coverage: float = 0.6
    tilt: float = 20.0  # degrees
    distances: float = 1.5
    rms: float = 0.5  # px
    held_out: float = 1.5
    noise: float = 0.05  # px, which is no reason to worry
    rejected: float = 0.25
    focal_lengths: float = 0.05


LIMITS = Limits()


@dataclass(frozen=True)
class ViewQuality:
    """A view that was used, and how well it fits.

    Attributes:
        name: of the pair.
        left: rms distance of the corners in the left view from where the rig puts them, in pixels.
        right: the same of the right view.
        tilt: of the board against the image of the left camera, in degrees.
        distance: of the middle of its corners from the left camera, in metres.
    """

    name: str
    left: float
    right: float
    tilt: float
    distance: float


@dataclass(frozen=True, eq=False)
class Quality:
    """Errors in pixels, and where the board was.

    Attributes:
        views: that were used.
        rms: of the distances between corners and where the rig puts them.
        epipolar_rms: of the differences of rows after rectification.
        held_out_rms: the same on views that the solution had not seen.
        left_coverage: (6, 8) corners in each cell of the left image.
        right_coverage: the same of the right image.
        tilt: the largest angle between two positions of the board, in degrees.
        distances: of the nearest and of the farthest board, in metres.
    """

    views: int
    rms: float
    epipolar_rms: float
    held_out_rms: float
    left_coverage: npt.NDArray[np.intp]
    right_coverage: npt.NDArray[np.intp]
    tilt: float
    distances: tuple[float, float]

    def to_dict(self) -> dict[str, Any]:
        """The values, ready for JSON."""
        lists = {side: getattr(self, side).tolist() for side in ("left_coverage", "right_coverage")}
        return {**asdict(self), **lists, "distances": list(self.distances)}


def epipolar_rms(rectification: Rectification, rig: Rig, views: Iterable[BoardView]) -> float:
    """Root mean square of the difference of rows, in rectified pixels. NaN without views."""
    pairs = [rectified_points(rectification, rig, view) for view in views]
    errors = [left[:, 1] - right[:, 1] for left, right in pairs]
    return float(np.sqrt(np.square(np.concatenate(errors)).mean())) if errors else float("nan")


def rectified_points(
    rectification: Rectification, rig: Rig, view: BoardView
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Where the points of a view lie in the rectified pair, (N, 2) each."""
    camera = rectification.calibration
    matrix = np.array([[camera.fx, 0, camera.cx0], [0, camera.fy, camera.known_cy()], [0, 0, 1]])
    return (
        _rectified(rig.left, view.left, rectification.left_rotation, matrix),
        _rectified(rig.right, view.right, rectification.right_rotation, matrix),
    )


def coverage(points: Iterable[npt.NDArray[np.float64]], size: tuple[int, int]) -> npt.NDArray[np.intp]:
    """How many corners lie in each cell of a grid of 6 rows and 8 columns."""
    x, y = np.concatenate(list(points)).T
    counts, *_ = np.histogram2d(y, x, bins=_CELLS, range=[[-0.5, size[0] - 0.5], [-0.5, size[1] - 0.5]])
    return counts.astype(np.intp)


def share_covered(counts: npt.NDArray[np.intp]) -> float:
    """The part of the cells of `coverage` that hold corners."""
    return float((counts > 0).mean())


def largest_tilt(turns: Sequence[npt.NDArray[np.float64]]) -> float:
    """The largest angle between two boards in degrees, of their turns as vectors along the axis."""
    normals = np.stack([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1))).max())


def view_quality(solution: Solution, views: Sequence[BoardView]) -> Iterator[ViewQuality]:
    """The errors of each view, and where its board was."""
    for view, (left, right), turn, place in zip(
        views, solution.errors.tolist(), solution.turns, solution.places, strict=True
    ):
        rotation = cv2.Rodrigues(turn)[0]
        middle = rotation @ view.object_points.mean(axis=0) + place
        tilt = float(np.degrees(np.arccos(np.clip(abs(rotation[2, 2]), 0, 1))))
        yield ViewQuality(view.name, left, right, tilt, float(np.linalg.norm(middle)))


def cautions(quality: Quality, rig: Rig, views: int, rejected: int) -> tuple[str, ...]:
    """What may be wrong with a calibration, in words that say what to do."""
    return tuple(_cautions(quality, rig, views, rejected))


def _cautions(quality: Quality, rig: Rig, views: int, rejected: int) -> Iterator[str]:
    for side, counts in (("left", quality.left_coverage), ("right", quality.right_coverage)):
        share = share_covered(counts)
        corners = counts[[0, 0, -1, -1], [0, -1, 0, -1]]
        if share < LIMITS.coverage:
            yield (
                f"the board was seen in {share:.0%} of the {side} image; show it in all of it, at least "
                f"{LIMITS.coverage:.0%}"
            )
        elif (corners == 0).any():
            yield (
                f"the board was never seen in {(corners == 0).sum()} of the 4 corners of the {side} image; show "
                "it there too"
            )
    if quality.tilt < LIMITS.tilt:
        yield f"the board was tilted by {quality.tilt:.0f} degrees at most; tilt it by 20 to 45, in all directions"
    near, far = quality.distances
    if far < LIMITS.distances * near:
        yield f"the board was {near:.2g} to {far:.2g} m away; show it at distances that differ by more, such as 1 : 2"
    if quality.rms > LIMITS.rms:
        yield (
            f"the error is {quality.rms:.2f} px; expected 0.5 or less: check that the board is flat and its sizes "
            "are right"
        )
    if quality.held_out_rms > max(LIMITS.held_out * quality.epipolar_rms, LIMITS.noise):
        yield (
            f"rows differ by {quality.held_out_rms:.2f} px in views held out and by {quality.epipolar_rms:.2f} px "
            "in the others; "
            "take more views"
        )
    if rejected > LIMITS.rejected * views:
        yield f"{rejected} of {views} views were rejected; check that both cameras take their pictures at one moment"
    ratio = rig.left.fx / rig.right.fx
    if abs(ratio - 1) > LIMITS.focal_lengths:
        yield f"the focal lengths are {rig.left.fx:.0f} and {rig.right.fx:.0f} px; expected two cameras alike"


def _rectified(
    camera: Camera, points: npt.NDArray[np.float64], rotation: npt.NDArray[np.float64], matrix: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    given = points.reshape(-1, 1, 2), camera.matrix, camera.coefficients
    if camera.model == "fisheye":
        found = cv2.fisheye.undistortPoints(*given, R=rotation, P=matrix)
    else:
        found = cv2.undistortPoints(*given, R=rotation, P=matrix)
    return np.asarray(found, np.float64).reshape(-1, 2)
