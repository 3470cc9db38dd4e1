"""A rig out of views of a board: solved, rid of poor views, and judged on views held out."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from stereokit.cameras.calibration_quality import (
    Quality,
    ViewQuality,
    cautions,
    coverage,
    epipolar_rms,
    largest_tilt,
    view_quality,
)
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rig import Model, Rig
from stereokit.cameras.solving import COEFFICIENTS, Solution, solve_rig
from stereokit.cameras.views import BoardView
from stereokit.errors import InputError
from stereokit.tables import counted

__all__ = ["LEAST_VIEWS", "RigCalibration", "calibrate_rig"]

LEAST_VIEWS = 8
"""That a calibration takes by default."""

_HELD_OUT = 5  # every fifth view


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """A rig and how good it is.

    Attributes:
        rig: the two cameras.
        quality: errors and coverage.
        views: those that were used.
        rejected: rms error in pixels, when they were left out, of the views whose errors stood out, by name, the worst
            first.
        warnings: what may be wrong, and what to do.
    """

    rig: Rig
    quality: Quality
    views: tuple[ViewQuality, ...]
    rejected: dict[str, float]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Errors and warnings as plain values, which `Rig.write` keeps as `about`."""
        return {
            "quality": self.quality.to_dict(),
            "views": [asdict(view) for view in self.views],
            "rejected": self.rejected,
            "warnings": list(self.warnings),
        }


def calibrate_rig(
    views: Sequence[BoardView],
    size: tuple[int, int],
    *,
    model: Model = "pinhole",
    coefficients: int = 4,
    least_views: int = LEAST_VIEWS,
) -> RigCalibration:
    """Solves for both cameras and how they stand.

    Each camera is solved alone, then both together from there. Views whose error in the joint solution stands out are
    left out, the worst first, with a new solution after each; a poor match of the two views does not show in one camera
    alone. Every fifth of the views kept is then left out of one more solution, and measures it.

    Args:
        views: that show the board, see `find_views`.
        size: height and width of the images.
        model: "pinhole" or "fisheye".
        coefficients: of distortion for pinhole cameras: 4 (k1 k2 p1 p2), 5 (k3 too) or 8 (rational). More of them go
            astray where the board never was.
        least_views: to be kept, at least 5.

    Raises:
        InputError: too few views, cameras that make no rig (swapped, one above the other, a baseline outside of 5 mm to
            5 m), or views that can't be solved for.

    Source: Z. Zhang, A flexible new technique for camera calibration, 2000; OpenCV's `stereoCalibrate`.
    """
    if coefficients not in COEFFICIENTS:
        raise InputError(f"calibrate: pinhole cameras have 4, 5 or 8 coefficients, got {coefficients}")
    if model == "fisheye" and coefficients != 4:
        raise InputError(f"calibrate: fisheye cameras have 4 coefficients, got {coefficients}")
    if least_views < _HELD_OUT:
        raise InputError(f"calibrate: at least {_HELD_OUT} views must be kept, got least_views={least_views}")
    if len(views) < least_views:
        raise InputError(
            f"calibrate: {counted(len(views), 'view')} of the board; expected at least {least_views}, better 20 or "
            "more, at different distances and angles, all over both images"
        )
    kept, rejected = list(views), dict[str, float]()
    solution = solve_rig(kept, size, model, coefficients)
    while len(kept) > least_views and (worst := _outlier(solution.errors)) is not None:
        rejected[kept.pop(worst).name] = float(solution.errors[worst].max())
        solution = solve_rig(kept, size, model, coefficients)
    used = [view for i, view in enumerate(kept) if i % _HELD_OUT != _HELD_OUT - 1]
    quality = _quality(solution, kept, size, held_out_by=solve_rig(used, size, model, coefficients).rig)
    return RigCalibration(
        solution.rig,
        quality,
        tuple(view_quality(solution, kept)),
        rejected,
        cautions(quality, solution.rig, len(views), len(rejected)),
    )


def _quality(solution: Solution, kept: Sequence[BoardView], size: tuple[int, int], *, held_out_by: Rig) -> Quality:
    distances = [view.distance for view in view_quality(solution, kept)]
    return Quality(
        views=len(kept),
        rms=solution.rms,
        epipolar_rms=epipolar_rms(rectify(solution.rig), solution.rig, kept),
        held_out_rms=epipolar_rms(rectify(held_out_by), held_out_by, kept[_HELD_OUT - 1 :: _HELD_OUT]),
        left_coverage=coverage([view.left for view in kept], size),
        right_coverage=coverage([view.right for view in kept], size),
        tilt=largest_tilt(solution.turns),
        distances=(min(distances), max(distances)),
    )


def _outlier(errors: npt.NDArray[np.float64]) -> int | None:
    """The view of the largest error, if that stands out."""
    worst = errors.max(axis=1)
    middle = float(np.median(worst))
    deviation = 1.4826 * float(np.median(np.abs(worst - middle)))
    return int(worst.argmax()) if worst.max() > max(middle + 4 * deviation, 2 * middle) else None
