"""The page with everything in it, as one file."""

import base64
import json
import os
from importlib.resources import files
from typing import Any

import numpy as np

from stereokit.errors import ConfigError, InputError
from stereokit.files import atomic_path
from stereokit.viewer.desk import Desk
from stereokit.viewer.packing import DISPARITY_STEPS, pack_bits, pack_map, quantised
from stereokit.viewer.shot import Shot, encode_image
from stereokit.viewer.sources import Album

__all__ = ["PAGE_FILES", "write_page"]

SCRIPTS = (
    "geometry.js",
    "source.js",
    "picture.js",
    "points_webgl.js",
    "points_raster.js",
    "cloud.js",
    "chart.js",
    "app.js",
)
PAGE_FILES = ("index.html", "viewer.css", *SCRIPTS)
"""Of the page; whatever else there is, is not served."""

GRID_POINTS = 1500
"""Pixels, about, whose distributions a page holds."""

MOST_PAIRS = 24
"""In one page, which a browser still opens at once."""

_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:; connect-src data:"
)


def write_page(path: str | os.PathLike[str], desk: Desk, *, overwrite: bool = False) -> int:
    """Writes one page that holds the pairs of an album and their results, and needs neither network nor server.

    Images become JPEG, disparity steps of 1/64 px, confidence steps of 1/255. Of the distributions those of every so
    many pixels are held, about 1,500 of a pair; the page says which. Distributions and occlusion need a network: they
    are left out of saved results.

    Args:
        path: the file.
        desk: what is shown.
        overwrite: replace an existing file.

    Returns:
        The size of the page in bytes.

    Raises:
        InputError: frames of a video or a camera, too many pairs, or a pair or a file that can't be used.
    """
    if not isinstance(desk.source, Album):
        raise InputError("a page holds pairs, not the frames of a video or a camera; save a frame from the live page")
    count = len(desk.source.pairs)
    if count > MOST_PAIRS:
        raise InputError(f"a page holds at most {MOST_PAIRS} pairs, got {count}; choose some with a pattern")
    shots = [_packed(desk, desk.entry(index)) for index in range(count)]
    facts = {**desk.facts(), "matching": False, "shots": shots}
    page = assemble(facts).encode()
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(page)
    return len(page)


def assemble(facts: dict[str, Any]) -> str:
    """The page's files in one, with what it shows."""
    folder = files("stereokit.viewer").joinpath("page")
    html = folder.joinpath("index.html").read_text(encoding="utf-8")
    style = folder.joinpath("viewer.css").read_text(encoding="utf-8")
    policy = f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
    html = html.replace('<link rel="stylesheet" href="viewer.css">', f"{policy}\n<style>\n{style}</style>")
    for name in SCRIPTS:
        script = folder.joinpath(name).read_text(encoding="utf-8")
        html = html.replace(f'<script src="{name}" defer></script>', f"<script>\n{script}</script>")
    # within a script element nothing but its end tag has a meaning
    data = json.dumps(facts).replace("<", "\\u003c")
    return html.replace("<!-- data -->", f'<script type="application/json" id="embedded">{data}</script>')


def _packed(desk: Desk, shot: Shot) -> dict[str, Any]:
    confidence = shot.result.confidence
    levels = None if confidence is None else np.rint(np.nan_to_num(confidence) * 255).astype(np.uint16)
    return {
        **shot.facts(),
        "left": _data_uri(shot.left),
        "right": _data_uri(shot.right),
        "steps": DISPARITY_STEPS,
        "disparity": pack_map(quantised(shot.result.disparity)),
        "levels": None if levels is None else pack_map(levels),
        "occluded": None if desk.predictor is None else pack_bits(np.packbits(desk.occluded(shot.number))),
        "distributions": None if desk.predictor is None else _grid(desk, shot),
    }


def _grid(desk: Desk, shot: Shot) -> dict[str, Any] | None:
    """The distributions at the middles of squares, about as many as `GRID_POINTS`."""
    height, width = shot.result.size
    step = max(1, round((height * width / GRID_POINTS) ** 0.5))
    rows, columns = np.arange(step // 2, height, step), np.arange(step // 2, width, step)
    try:
        distributions = desk.distributions(shot.number)
    except ConfigError:
        return None
    found = distributions.at(np.repeat(rows, len(columns)), np.tile(columns, len(rows)))
    # the largest is 65535, so that a uniform distribution over many keeps its digits
    peak = found.probabilities.max(1, keepdims=True)
    alike = bool((found.disparities == found.disparities[0]).all())
    return {
        "step": step,
        "first": step // 2,
        "rows": len(rows),
        "columns": len(columns),
        "candidates": found.disparities.shape[1],
        "disparities": pack_bits((found.disparities[:1] if alike else found.disparities).astype("<f4")),
        "probabilities": pack_bits(np.rint(found.probabilities / peak * 65535).astype("<u2")),
        "peaks": pack_bits(peak.astype("<f4")),
        "kept": pack_bits(found.kept.astype(np.uint8)),
        "expectations": pack_bits(found.expectation.astype("<f4")),
        "spreads": pack_bits(found.spread.astype("<f4")),
    }


def _data_uri(image: Any) -> str:
    content, kind = encode_image(image, ".jpg")
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
