"""How the two cameras stand, judged by where matches lie."""

import math
from collections.abc import Iterator

import numpy as np

from stereokit.calibration.rectified import Calibration
from stereokit.cameras.checking.findings import Finding, Severity
from stereokit.cameras.checking.matching import Matches, RowFit
from stereokit.cameras.checking.thresholds import THRESHOLDS

__all__ = ["arrangement_findings", "disparity_findings", "row_findings"]


def arrangement_findings(matches: Matches, fit: RowFit, size: tuple[int, int]) -> Iterator[Finding]:
    """Views that are no left and right view at all: at most one of these is found."""
    dx, dy = matches.dx, matches.dy
    if max(np.percentile(np.abs(dx), 99), np.percentile(np.abs(dy), 99)) < THRESHOLDS.identical:
        yield Finding("same_image", "unusable", "left and right are the same image: give the views of both cameras")
        return
    if abs(fit.zoom) > size[0]:
        yield Finding(
            "turned",
            "unusable",
            "one view is turned by 180 degrees against the other: turn it around, and calibrate with it turned",
        )
        return
    spread = np.subtract(*np.percentile(dy, [95, 5]))
    # a few matches are wrong in any pair
    if np.percentile(np.abs(dx), 90) < THRESHOLDS.vertical_rig_columns and spread > THRESHOLDS.vertical_rig_rows:
        above = "left" if np.median(dy) < 0 else "right"
        yield Finding(
            "vertical_rig",
            "unusable",
            f"the cameras stand one above the other, the {above} view's above: turn both views by 90 degrees, so that "
            "matches lie in one row",
        )
        return
    dx = dx[fit.inliers]
    in_order = float((dx > THRESHOLDS.order).mean())
    if in_order < THRESHOLDS.swapped_share and np.percentile(dx, 1) < THRESHOLDS.swapped_reach:
        yield Finding(
            "swapped",
            "unusable",
            f"{1 - in_order:.0%} of the matches lie further right in the right view: the views are swapped, so "
            "exchange left and right; or both are mirrored, or turned by 180 degrees, so undo that",
        )


def row_findings(fit: RowFit, size: tuple[int, int]) -> Iterator[Finding]:
    """Matches that do not lie in one row."""
    if severity := _severity(fit.offset, THRESHOLDS.rows_warning, THRESHOLDS.rows_unusable):
        height, width = size
        side = "lower" if fit.shift > 0 else "higher"
        degrees = math.degrees(math.asin(max(-1.0, min(1.0, fit.roll / width))))
        factor = 1 + fit.zoom / height
        parts = {
            "vertical_shift": (fit.shift, f"the right view lies {abs(fit.shift):.1f} px {side} than the left one"),
            "roll": (fit.roll / 2, f"the right view is turned by {degrees:.2f} degrees against the left one"),
            "zoom": (
                fit.zoom / 2,
                f"the right view is {factor:.4f} times as large as the left one, or its lens is not corrected",
            ),
        }
        worst = max(abs(value) for value, _ in parts.values())
        for name, (value, message) in parts.items():
            if abs(value) >= min(THRESHOLDS.component, worst):
                yield Finding(
                    name, severity, f"{message}: rectify the pair, with a calibration made since the cameras last moved"
                )
    if severity := _severity(fit.scatter, THRESHOLDS.scatter_warning, THRESHOLDS.scatter_unusable):
        yield Finding(
            "unrectified",
            severity,
            f"matches lie {fit.scatter:.1f} px from one row, and neither shift, turn nor size explain it: rectify the "
            "pair; if it is rectified, check that both frames are of one moment",
        )


def disparity_findings(
    matches: Matches, fit: RowFit, calibration: Calibration | None, max_disparity: float | None
) -> Iterator[Finding]:
    """Disparities that are negative, larger than what is searched, or at odds with the calibration."""
    dx = matches.dx[fit.inliers]
    low, high = (float(value) for value in np.percentile(dx, [1, 99.5]))
    if low < THRESHOLDS.toed_in:
        shift = math.ceil(-low) + 1
        share = float((dx < THRESHOLDS.order).mean())
        moved = "" if calibration is None else f"; cx1 - cx0 is then {calibration.doffs - shift:g} px"
        yield Finding(
            "toed_in",
            "unusable" if share > THRESHOLDS.toed_in_unusable else "warning",
            f"{share:.0%} of the matches have a disparity below 0, down to {low:.1f} px, because the cameras are toed "
            "in or "
            f"one view was cropped: cut {shift} columns off the left of the right view and off the right of the left "
            f"one, and use calibration.cropped(left=0, left_of_right={shift}, ...){moved}",
        )
    if max_disparity is not None and high > THRESHOLDS.range_part * max_disparity:
        scale = max(math.floor(20 * THRESHOLDS.range_part * max_disparity / high) / 20, 0.05)
        yield Finding(
            "range",
            "warning",
            f"disparity reaches {high:.0f} px, near or beyond the largest that is searched, {max_disparity:g} px: use "
            f"--scale {scale:g} (scale={scale:g}), or a network of a larger max_disparity",
        )
    if calibration is not None:
        behind = float((dx + calibration.doffs <= 0).mean())
        if behind > THRESHOLDS.behind:
            yield Finding(
                "calibration",
                "warning",
                f"the calibration, with cx1 - cx0 = {calibration.doffs:g} px, puts {behind:.0%} of the matches behind "
                "the cameras: check that it belongs to these images, and to these crops of them",
            )


def _severity(value: float, warning: float, unusable: float) -> Severity | None:
    return "unusable" if value > unusable else "warning" if value > warning else None
