"""What the views look like, each by itself and against the other: exposure, bit depth, blur, constant rows."""

import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.cameras.checking.findings import Finding
from stereokit.cameras.checking.matching import Matches
from stereokit.cameras.checking.thresholds import THRESHOLDS
from stereokit.tables import counted

__all__ = ["as_grey", "bit_depth_findings", "blur_findings", "constant_row_findings", "exposure_findings", "gain"]

_SIDES = ("left", "right")
_PATCH = 9


def as_grey(image: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Brightness in [0, 1] of an image (H, W, 3), uint8 or floating-point in [0, 1]."""
    scale = np.float32(1 / 255 if image.dtype == np.uint8 else 1)
    return np.asarray(cv2.cvtColor(image.astype(np.float32), cv2.COLOR_RGB2GRAY), np.float32) * scale


def bit_depth_findings(views: tuple[npt.NDArray[Any], npt.NDArray[Any]]) -> Iterator[Finding]:
    """Images of 16 bits (here floating-point) of which only the lower bits are used."""
    for side, view in zip(_SIDES, views, strict=True):
        peak = float(view.max()) if view.dtype != np.uint8 else 1.0
        if 0 < peak < THRESHOLDS.bit_depth:
            factor = 2 ** math.floor(-math.log2(peak))
            bits = 16 - round(math.log2(factor))
            yield Finding(
                "bit_depth",
                "warning",
                f"the {side} view uses 1/{1 / peak:.0f} of the range of its 16 bits, as images of {bits} bits do: "
                f"multiply its samples by {factor}",
            )


def gain(grey: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]], matches: Matches) -> float:
    """Brightness of the right view in parts of the left one's: the median over small patches around the matches."""
    values = []
    for view, places in zip(grey, (matches.left, matches.right), strict=True):
        mean = cv2.blur(view, (_PATCH, _PATCH))
        columns, rows = np.rint(places).astype(np.intp).T
        values.append(mean[rows, columns] + 1e-3)
    return float(np.median(values[1] / values[0]))


def exposure_findings(
    grey: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]], brightness: float | None
) -> Iterator[Finding]:
    """Different brightness, and pixels without any difference left in them."""
    if brightness is not None and not THRESHOLDS.least_gain <= brightness <= THRESHOLDS.most_gain:
        yield Finding(
            "exposure",
            "warning",
            f"the right view is {brightness:.2f} times as bright as the left one: give both cameras one exposure and "
            "gain, or match histograms first",
        )
    for side, view in zip(_SIDES, grey, strict=True):
        for tone, share, remedy in (
            ("white", float((view >= 254.5 / 255).mean()), "shorten"),
            ("black", float((view <= 0.5 / 255).mean()), "lengthen"),
        ):
            if share > THRESHOLDS.clipped:
                yield Finding(
                    "clipped",
                    "warning",
                    f"{share:.0%} of the {side} view is {tone}, where nothing can be matched: {remedy} the exposure, "
                    "or mask borders",
                )


def blur_findings(grey: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]) -> Iterator[Finding]:
    """One view less sharp than the other, at equal brightness."""
    sharpness = [float(cv2.Laplacian(view / max(float(view.mean()), 1e-3), cv2.CV_32F).var()) for view in grey]
    for i, side in enumerate(_SIDES):
        if sharpness[i] < THRESHOLDS.blur * sharpness[1 - i]:
            yield Finding(
                "blur",
                "warning",
                f"the {side} view has {sharpness[i] / sharpness[1 - i]:.2f} times the sharpness of the other: clean "
                "and focus its lens, or look for motion blur or for noise in the other",
            )


def constant_row_findings(grey: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]) -> Iterator[Finding]:
    """Rows of one value at the upper or lower border: bars, or data that a camera writes into its pictures."""
    for side, view in zip(_SIDES, grey, strict=True):
        varied = np.flatnonzero(np.ptp(view, axis=1) > 1 / 512)
        if not len(varied):
            continue  # without any texture, which is said elsewhere
        for border, count in (("upper", int(varied[0])), ("lower", len(view) - 1 - int(varied[-1]))):
            if count >= THRESHOLDS.constant_rows:
                yield Finding(
                    "constant_rows",
                    "warning",
                    f"{counted(count, 'row')} at the {border} border of the {side} view hold one value: crop them off "
                    "both views, and the calibration with them",
                )
