"""The check of a pair."""

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from stereokit.calibration.rectified import Calibration
from stereokit.cameras.checking.appearance import (
    as_grey,
    bit_depth_findings,
    blur_findings,
    constant_row_findings,
    exposure_findings,
    gain,
)
from stereokit.cameras.checking.findings import SEVERITIES, Finding, Severity
from stereokit.cameras.checking.geometry import arrangement_findings, disparity_findings, row_findings
from stereokit.cameras.checking.matching import Matches, RowFit, fit_rows, match_views
from stereokit.cameras.checking.thresholds import THRESHOLDS
from stereokit.data.inputs import ImageLike, to_image_tensor
from stereokit.errors import InputError

__all__ = ["PairCheck", "check_pair"]


@dataclass(frozen=True, eq=False)
class PairCheck:
    """What was found in a pair.

    Attributes:
        findings: what is wrong, the worst first; none where all is well.
        measured: numbers behind it by name, None where they could not be measured. Lengths are in pixels.
        matches: points that both views show; None where the views have different sizes.
        inliers: (N,) which of them the fit of rows explains; None where there are too few.
    """

    findings: tuple[Finding, ...]
    measured: dict[str, float | int | None]
    matches: Matches | None = None
    inliers: npt.NDArray[np.bool_] | None = None

    @property
    def severity(self) -> Severity:
        """That of the worst finding, or "good"."""
        return max((finding.severity for finding in self.findings), key=SEVERITIES.index, default="good")

    def to_dict(self) -> dict[str, Any]:
        """The result as plain values, ready for JSON."""
        findings = [finding.to_dict() for finding in self.findings]
        return {"severity": self.severity, "findings": findings, "measured": self.measured}

    def __str__(self) -> str:
        """In words, a line for each finding."""
        lines = [f"{finding.severity}: {finding.message}" for finding in self.findings]
        return "\n".join(lines or ["good: nothing is wrong with this pair"])


def check_pair(
    left: ImageLike,
    right: ImageLike,
    calibration: Calibration | None = None,
    max_disparity: float | None = None,
) -> PairCheck:
    """Finds out whether a pair is rectified, in order, and fit to be matched.

    Points that both views show are found with SIFT. In a rectified pair they lie in one row, and further left in the
    right view. The result is the same every time. A pair of 640 x 480 takes about a second.

    Args:
        left: the left view, a path, an array or another `ImageLike`.
        right: the right view.
        calibration: of the pair, to be checked against it.
        max_disparity: the largest that is searched, in pixels of these images.

    Returns:
        The findings by these names: "size", "calibration_size", "textureless", "unrelated", "mirrored", "same_image",
        "turned", "vertical_rig", "swapped", "vertical_shift", "roll", "zoom", "unrectified", "toed_in", "range",
        "calibration", "exposure", "clipped", "bit_depth", "blur", "constant_rows".

    Raises:
        InputError: no images, or a `max_disparity` that is not positive. A bad pair is no error.

    >>> from stereokit.data.synthetic import SyntheticScenes
    >>> pair = SyntheticScenes(seed=0, size=(240, 320), max_disparity=40, photometric=0)[3]
    >>> print(check_pair(pair.left, pair.right))
    good: nothing is wrong with this pair
    >>> [finding.name for finding in check_pair(pair.right, pair.left).findings]
    ['swapped']
    """
    if max_disparity is not None and not max_disparity > 0:
        raise InputError(f"max_disparity must be a positive number of pixels, got {max_disparity}")
    views = _array(left, "left"), _array(right, "right")
    findings = [*_size_findings(views, calibration), *bit_depth_findings(views)]
    if views[0].shape != views[1].shape:
        return PairCheck(_sorted(findings), {})
    height, width = views[0].shape[:2]
    size = height, width
    grey = as_grey(views[0]), as_grey(views[1])
    matches = match_views(_stretched(grey[0]), _stretched(grey[1]))
    measured: dict[str, float | int | None] = {"matches": len(matches)}
    fit = None
    brightness = None
    if len(matches) < THRESHOLDS.least_matches:
        findings += _unmatched_findings(matches, grey)
    else:
        fit = fit_rows(matches, size)
        brightness = gain(grey, matches)
        measured |= _measured(matches, fit, size, brightness)
        arrangement = list(arrangement_findings(matches, fit, size))
        # of such a pair rows and disparities say nothing more
        if not arrangement:
            fitting = calibration if not any(finding.name == "calibration_size" for finding in findings) else None
            arrangement = [*row_findings(fit, size), *disparity_findings(matches, fit, fitting, max_disparity)]
        findings += arrangement
    findings += [*exposure_findings(grey, brightness), *blur_findings(grey), *constant_row_findings(grey)]
    return PairCheck(_sorted(findings), measured, matches, None if fit is None else fit.inliers)


def _array(image: ImageLike, name: str) -> npt.NDArray[Any]:
    with warnings.catch_warnings():
        # the findings say more of the bit depth than the reader's warning
        warnings.simplefilter("ignore", UserWarning)
        return to_image_tensor(image, name)[0].permute(1, 2, 0).numpy()


def _sorted(findings: list[Finding]) -> tuple[Finding, ...]:
    return tuple(sorted(findings, key=lambda finding: -SEVERITIES.index(finding.severity)))


def _stretched(grey: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """8 bits, a dark image brightened: features are sought by their contrast."""
    peak = float(grey.max())
    scale = 1 / peak if 0 < peak < 0.5 else 1.0
    return np.rint(np.clip(grey * scale, 0, 1) * 255).astype(np.uint8)


def _size_findings(
    views: tuple[npt.NDArray[Any], npt.NDArray[Any]], calibration: Calibration | None
) -> Iterator[Finding]:
    (height, width), other = views[0].shape[:2], views[1].shape[:2]
    if (height, width) != other:
        yield Finding(
            "size",
            "unusable",
            f"the left view has {width} x {height} pixels, the right one {other[1]} x {other[0]}: give views of one "
            "size, neither cropped nor resized after rectification",
        )
    if calibration is not None:
        try:
            calibration.check_size(height, width)
        except InputError as error:
            yield Finding("calibration_size", "unusable", str(error))


def _unmatched_findings(
    matches: Matches, grey: tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]
) -> Iterator[Finding]:
    """Why next to nothing matches."""
    bare = [side for side, count in zip(("left", "right"), matches.keypoints, strict=True) if _few(count)]
    if bare:
        yield Finding(
            "textureless",
            "unusable",
            f"the {' and the '.join(bare)} view {'has' if len(bare) == 1 else 'have'} next to no texture: check "
            "exposure and lens caps, or light the scene with a pattern",
        )
        return
    mirrored = match_views(_stretched(grey[0]), np.ascontiguousarray(_stretched(grey[1])[:, ::-1]))
    if len(mirrored) >= max(THRESHOLDS.least_matches, 2 * len(matches)):
        yield Finding("mirrored", "unusable", "one view is mirrored: flip it back")
        return
    yield Finding(
        "unrelated",
        "unusable",
        f"only {len(matches)} points of the left view are found in the right one: the views show different scenes or "
        "moments, or are too far apart",
    )


def _few(count: int) -> bool:
    return count < THRESHOLDS.least_keypoints


def _measured(matches: Matches, fit: RowFit, size: tuple[int, int], brightness: float) -> dict[str, float | int | None]:
    dx = matches.dx[fit.inliers]
    low, middle, high = np.percentile(dx, [1, 50, 99.5])
    values = {
        "vertical_shift": fit.shift,
        "roll": fit.roll,
        "zoom": fit.zoom,
        "row_offset": fit.offset,
        "row_scatter": fit.scatter,
        "disparity_low": low,
        "disparity_median": middle,
        "disparity_high": high,
        "in_order": (dx > THRESHOLDS.order).mean(),
        "gain": brightness,
    }
    return {name: round(float(value), 4) for name, value in values.items()}
