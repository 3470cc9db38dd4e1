"""Errors of a disparity map against ground truth, counted as the benchmarks count them.

A pixel counts where its truth d* is known, which is finite and 0 < d* (< `max_disparity`, where a ceiling is
given), and where the caller's mask holds. A prediction d that is not finite is an error of infinite size: bad
at every threshold. It has no end-point error, so the mean end-point error leaves it out, and
`invalid_predictions` says how many there are. Shares are in percent. A mean over no pixels is None.
`docs/metrics.md` has all rules in one table.
"""

from stereokit.metrics.accumulation import StereoMetrics
from stereokit.metrics.known import PixelCounts, count_pixels, valid_pixels
from stereokit.metrics.measures import KITTI_METRICS, bad_pixels, d1, end_point_error, invalid_predictions

__all__ = [
    "KITTI_METRICS",
    "PixelCounts",
    "StereoMetrics",
    "bad_pixels",
    "count_pixels",
    "d1",
    "end_point_error",
    "invalid_predictions",
    "valid_pixels",
]
