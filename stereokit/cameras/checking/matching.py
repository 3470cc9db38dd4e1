"""Points that both views show, and how their rows differ."""

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

__all__ = ["Matches", "RowFit", "fit_rows", "match_views"]

Grey: TypeAlias = npt.NDArray[np.uint8]
Points: TypeAlias = npt.NDArray[np.float64]

_LONGEST_SIDE = 1280
_FEATURES = 4000
_CONTRAST = 0.01
_RATIO = 0.75
_TRIALS = 400
_OUTLIER = 3.0  # px


@dataclass(frozen=True, eq=False)
class Matches:
    """Points of the left view and the same points in the right one.

    Attributes:
        left: (N, 2) column and row.
        right: the same.
        keypoints: how many points stand out in the left and in the right view.
    """

    left: Points
    right: Points
    keypoints: tuple[int, int]

    def __len__(self) -> int:
        return len(self.left)

    @property
    def dx(self) -> npt.NDArray[np.float64]:
        """Disparity of each, x_left - x_right."""
        return self.left[:, 0] - self.right[:, 0]

    @property
    def dy(self) -> npt.NDArray[np.float64]:
        """By how many rows each lies lower in the right view."""
        return self.right[:, 1] - self.left[:, 1]


@dataclass(frozen=True, eq=False)
class RowFit:
    """dy = shift + roll (x - cx) / W + zoom (y - cy) / H, fitted robustly; all in pixels.

    Attributes:
        shift: at the centre.
        roll: from the left to the right border.
        zoom: from the upper to the lower border.
        offset: 95th percentile of the fit's absolute value over the matches.
        scatter: robust standard deviation around the fit.
        inliers: (N,) which matches it explains.
    """

    shift: float
    roll: float
    zoom: float
    offset: float
    scatter: float
    inliers: npt.NDArray[np.bool_]


def match_views(left: Grey, right: Grey) -> Matches:
    """Mutual nearest neighbours among SIFT's features that are clearly nearer than the second.

    Images are searched at no more than 1280 pixels a side. The result is the same every time.

    Source: D. Lowe, Distinctive Image Features from Scale-Invariant Keypoints, IJCV 2004.
    """
    factor = min(1.0, _LONGEST_SIDE / max(left.shape))
    places, descriptors = zip(*(_features(view, factor) for view in (left, right)), strict=True)
    keypoints = len(places[0]), len(places[1])
    if min(keypoints) < 2:
        none = np.zeros((0, 2))
        return Matches(none, none, keypoints)
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = np.array([pair[0].trainIdx for pair in matcher.knnMatch(descriptors[1], descriptors[0], k=1)])
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second in matcher.knnMatch(descriptors[0], descriptors[1], k=2)
        if best.distance < _RATIO * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    first, other = np.array(pairs, np.intp).reshape(-1, 2).T
    return Matches(places[0][first], places[1][other], keypoints)


def fit_rows(matches: Matches, size: tuple[int, int]) -> RowFit:
    """Fits a plane to the vertical offsets: the best of many planes through three matches, then least squares.

    Args:
        matches: at least three.
        size: height and width of the views.
    """
    height, width = size
    x, y = matches.left[:, 0], matches.left[:, 1]
    terms = np.stack([np.ones(len(x)), (x - (width - 1) / 2) / width, (y - (height - 1) / 2) / height], axis=1)
    dy = matches.dy
    triples = np.random.default_rng(0).integers(0, len(x), (_TRIALS, 3))
    triples = triples[np.abs(np.linalg.det(terms[triples])) > 1e-3]
    candidates = np.linalg.solve(terms[triples], dy[triples][:, :, None])[:, :, 0]
    candidates = np.concatenate([candidates, [[np.median(dy), 0, 0]]])
    costs = np.minimum(np.abs(dy - candidates @ terms.T), _OUTLIER).sum(axis=1)
    plane = candidates[np.argmin(costs)]
    inliers = np.ones(len(x), np.bool_)
    for _ in range(5):
        errors = np.abs(dy - terms @ plane)
        inliers = errors <= 3 * 1.4826 * np.median(errors) + 0.2
        if inliers.sum() >= 3:
            plane = np.linalg.lstsq(terms[inliers], dy[inliers], rcond=None)[0]
    fitted = terms @ plane
    scatter = 1.4826 * float(np.median(np.abs(dy - fitted)))
    shift, roll, zoom = (float(value) for value in plane)
    return RowFit(shift, roll, zoom, float(np.percentile(np.abs(fitted), 95)), scatter, inliers)


def _features(grey: Grey, factor: float) -> tuple[Points, npt.NDArray[np.float32]]:
    small = grey
    if factor < 1:
        small = np.asarray(cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8)
    found, descriptors = cv2.SIFT.create(_FEATURES, contrastThreshold=_CONTRAST).detectAndCompute(small, None)
    if not found:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    # at equal strength OpenCV may give a few more
    found, descriptors = found[:_FEATURES], np.asarray(descriptors, np.float32)[:_FEATURES]
    places = np.array([point.pt for point in found], np.float64)
    ratio = np.array([small.shape[1] / grey.shape[1], small.shape[0] / grey.shape[0]])
    return (places + 0.5) / ratio - 0.5, descriptors
