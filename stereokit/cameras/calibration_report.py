"""A page to judge a calibration by: errors, coverage, tilt and distance, and rectified views with their rows."""

import json
import os
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.calibrating import RigCalibration
from stereokit.cameras.calibration_quality import LIMITS, share_covered
from stereokit.cameras.rectification import rectify
from stereokit.cameras.views import FoundViews, ViewPair, to_grey
from stereokit.files import atomic_path
from stereokit.pictures.page import Figure, figures, page, photograph, table
from stereokit.tables import Table

__all__ = ["write_report"]

_LEFT, _RIGHT, _BAD = "#1f5f99", "#c26a1b", "#b3261e"
_ROWS = 14  # lines over an example


def write_report(
    path: str | os.PathLike[str],
    result: RigCalibration,
    found: FoundViews,
    examples: Iterable[ViewPair],
    record: Mapping[str, Any],
    *,
    overwrite: bool = False,
) -> None:
    """Writes one HTML file that holds its pictures and loads nothing.

    Args:
        path: the file.
        result: of `calibrate_rig`.
        found: of `find_views`.
        examples: pairs to show rectified.
        record: what else is worth keeping, shown as JSON.
        overwrite: replace an existing file.

    Raises:
        InputError: a file that can't be written.
    """
    quality, rig = result.quality, result.rig
    facts = f"{found.size[1]} x {found.size[0]} px · {rig.left.model} · {quality.views} views · {record['made']['at']}"
    warnings = "".join(f"<li>{escape(warning)}</li>" for warning in result.warnings)
    verdict = f'<ul class="notes">{warnings}</ul>' if warnings else "<p>Nothing to complain of.</p>"
    sections = [
        ("Is it good?", f"{verdict}{table(_numbers(result, found))}{_legend()}"),
        ("The rig", table(_rig(result))),
        ("Errors of the views", _errors(result)),
        ("Where the board was", figures([_coverage(result, found, side) for side in ("left", "right")], "coverage")),
        ("How it was held", _poses(result)),
        ("Rectified views", _examples(result, examples)),
        (
            "Record",
            f"<details><summary>All numbers</summary><pre>{escape(json.dumps(record, indent=2))}</pre></details>",
        ),
    ]
    body = "".join(f"<section><h2>{title}</h2>{content}</section>" for title, content in sections)
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_text(page("Calibration of a stereo rig", facts, body), encoding="utf-8")


def _numbers(result: RigCalibration, found: FoundViews) -> Table:
    quality = result.quality
    rows = [
        ("distance of corners from where the rig puts them (rms)", f"{quality.rms:.3f} px", f"≤ {LIMITS.rms} px"),
        ("difference of rows after rectification (rms)", f"{quality.epipolar_rms:.3f} px", ""),
        (
            "the same in views held out",
            f"{quality.held_out_rms:.3f} px",
            f"≤ {max(LIMITS.held_out * quality.epipolar_rms, LIMITS.noise):.3f} px",
        ),
        *(
            (f"part of the {side} image covered", f"{share_covered(counts):.0%}", f"≥ {LIMITS.coverage:.0%}")
            for side, counts in (("left", quality.left_coverage), ("right", quality.right_coverage))
        ),
        ("largest angle between two boards", f"{quality.tilt:.0f}°", f"≥ {LIMITS.tilt:.0f}°"),
        (
            "distances of the board",
            f"{quality.distances[0]:.2f} to {quality.distances[1]:.2f} m",
            f"farthest ≥ {LIMITS.distances} x nearest",
        ),
        (
            "views used, rejected, without the board",
            f"{quality.views}, {len(result.rejected)}, {len(found.unused)}",
            f"rejected ≤ {LIMITS.rejected:.0%}",
        ),
    ]
    return Table(("measure", "found", "expected"), tuple(rows))


def _rig(result: RigCalibration) -> Table:
    rig = result.rig
    rows = [
        (side, f"{c.fx:.2f}, {c.fy:.2f}", f"{c.cx:.2f}, {c.cy:.2f}", ", ".join(f"{k:.4g}" for k in c.distortion))
        for side, c in (("left", rig.left), ("right", rig.right))
    ]
    turn = np.degrees(cv2.Rodrigues(np.reshape(rig.rotation, (3, 3)))[0].ravel())
    move = np.array(rig.translation) * 1e3
    rows.append((f"baseline {rig.baseline * 1e3:.3f} mm", f"R {_listed(turn, '°')}", f"T {_listed(move, ' mm')}", ""))
    return Table(("camera", "focal lengths [px]", "principal point [px]", "distortion"), tuple(rows))


def _listed(values: npt.NDArray[np.float64], unit: str) -> str:
    return f"({', '.join(f'{value:.2f}' for value in values)}){unit}"


def _legend() -> str:
    swatches = "".join(
        f'<span><i style="background: {color}"></i>{name}</span>'
        for color, name in ((_LEFT, "left"), (_RIGHT, "right"), (_BAD, "rejected"))
    )
    return f'<div class="legend">{swatches}</div>'


def _errors(result: RigCalibration) -> str:
    """A bar for each camera of each view; rejected views stand last, cut off where they are much larger."""
    bars = [(view.name, (view.left, _LEFT), (view.right, _RIGHT)) for view in result.views]
    most = 1.5 * max(max(left, right) for _, (left, _), (right, _) in bars)
    out = [(name, (error, _BAD), (error, _BAD)) for name, error in result.rejected.items()]
    wide, high, edge = 1200, 220, 46
    step = (wide - edge) / max(len(bars) + len(out), 1)
    drawn = []
    for i, (name, *pair) in enumerate([*bars, *out]):
        for j, (error, color) in enumerate(pair):
            height = min(error / most, 1) * (high - 30)
            x = edge + i * step + (0.1 + 0.4 * j) * step
            drawn.append(
                f'<rect x="{x:.1f}" y="{high - 20 - height:.1f}" width="{0.36 * step:.1f}" height="{height:.1f}" '
                f'fill="{color}"><title>{escape(name)}: {error:.3f} px</title></rect>'
            )
    lines = [
        f'<text x="0" y="{high - 16 - part * (high - 30):.0f}">{part * most:.2f} px</text>' for part in (0, 0.5, 1)
    ]
    left_out = ", ".join(f"{name} ({error:.2f} px)" for name, error in result.rejected.items())
    words = f"Rejected: {escape(left_out)}." if left_out else "None was rejected."
    return (
        f'{_svg(wide, high, "".join(drawn + lines))}<p class="facts">{words} A bar tells its view when pointed at.</p>'
    )


def _coverage(result: RigCalibration, found: FoundViews, side: str) -> Figure:
    """The corners over the image, its cells the darker, the more corners they hold."""
    height, width = found.size
    counts = result.quality.left_coverage if side == "left" else result.quality.right_coverage
    scale = 600 / width
    image = np.full((round(height * scale), 600, 3), 255, np.uint8)
    rows, columns = counts.shape
    for (row, column), count in np.ndenumerate(counts):
        corners = [
            (round(x * image.shape[1] / columns), round(y * image.shape[0] / rows))
            for x, y in ((column, row), (column + 1, row + 1))
        ]
        depth = 0 if count == 0 else 25 + min(int(count), 60)
        cv2.rectangle(image, corners[0], corners[1], (255 - depth, 255 - depth // 3, 255), cv2.FILLED)
        cv2.rectangle(image, corners[0], corners[1], (205, 212, 220))
    used = {view.name for view in result.views}
    for view in found.views:
        color = (31, 95, 153) if view.name in used else (179, 38, 30)
        for x, y in getattr(view, side):
            place = round((x + 0.5) * scale * 8), round((y + 0.5) * scale * 8)
            cv2.circle(image, place, 10, color, cv2.FILLED, cv2.LINE_AA, 3)
    return Figure(f"{side.capitalize()} image", f"{share_covered(counts):.0%} of the cells", photograph(image))


def _poses(result: RigCalibration) -> str:
    """Tilt over distance."""
    wide, high, edge = 1200, 240, 46
    farthest = 1.05 * max(view.distance for view in result.views)
    most = max(45.0, 1.05 * max(view.tilt for view in result.views))
    dots = [
        f'<circle cx="{edge + view.distance / farthest * (wide - edge):.1f}" '
        f'cy="{(high - 24) * (1 - view.tilt / most):.1f}" r="5" fill="{_LEFT}" fill-opacity="0.6">'
        f"<title>{escape(view.name)}: {view.distance:.2f} m, {view.tilt:.0f} degrees</title></circle>"
        for view in result.views
    ]
    marks = [
        f'<text x="{edge + part * (wide - edge) - 40:.0f}" y="{high - 4}">{part * farthest:.2f} m</text>'
        for part in (0.25, 0.5, 0.75, 1)
    ]
    marks += [f'<text x="0" y="{(high - 24) * (1 - part) + 10:.0f}">{part * most:.0f}°</text>' for part in (0, 0.5, 1)]
    words = "Tilt of the board against the left image, over its distance. Wide and high is good."
    return f'{_svg(wide, high, "".join(dots + marks))}<p class="facts">{words}</p>'


def _examples(result: RigCalibration, examples: Iterable[ViewPair]) -> str:
    rectification = rectify(result.rig)
    shown = []
    for name, *pair in examples:
        both = np.hstack(rectification(to_grey(pair[0]), to_grey(pair[1])))
        image = np.repeat(both[:, :, None], 3, axis=2)
        for i in range(_ROWS):
            row = round((i + 0.5) * image.shape[0] / _ROWS)
            cv2.line(image, (0, row), (image.shape[1], row), (30, 170, 80), max(1, round(image.shape[1] / 700)))
        note = "left and right; what lies on a line left must lie on it right"
        shown.append(figures([Figure(name, note, photograph(image))], "rectified views"))
    return "".join(shown)


def _svg(width: int, height: int, content: str) -> str:
    return (
        f'<svg viewBox="0 0 {width} {height}" style="width: 100%; font: 12px system-ui, sans-serif; fill: #5b6875">'
        f"{content}</svg>"
    )
