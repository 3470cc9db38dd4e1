"""The numbers that decide, in one table."""

from dataclasses import dataclass

__all__ = ["THRESHOLDS", "Thresholds"]


@dataclass(frozen=True)
class Thresholds:
    """What a pair is measured against. Found on nine real pairs and on disturbed copies of three of them.

    Attributes:
        least_matches: below it the views show nothing in common, or nothing to match. Unrelated views gave 5, real
            pairs 387 and more.
        least_keypoints: below it a view has no texture.
        identical: no match is farther apart than this in the same image twice, in px.
        rows_warning: 95th percentile of the fitted vertical offset, in px. Middlebury and ETH3D reach 0.3, KITTI 1.6.
        rows_unusable: the same.
        component: a part of that offset (shift, roll, zoom) that is worth naming, in px at the border.
        scatter_warning: scatter of rows around the fit, in px. Real pairs reach 0.5.
        scatter_unusable: the same.
        order: a match is in order where its disparity is larger than this, in px.
        swapped_share: below this share of matches in order the views are swapped.
        swapped_reach: and some disparities reach below this, in px.
        toed_in: 1st percentile of disparity below which cameras are toed in, in px.
        toed_in_unusable: share of matches out of order above which the pair is of no use as it is.
        vertical_rig_columns: matches of a vertical rig are at most so many columns apart, in px.
        vertical_rig_rows: and their rows spread by more than this, in px.
        range_part: of the largest disparity, which the 99.5th percentile should not exceed.
        least_gain: brightness of the right view in parts of the left one's, at matches.
        most_gain: the same.
        clipped: share of pixels that are white or black. The sky of KITTI takes 13 %.
        bit_depth: brightest sample in parts of the range of a 16-bit image.
        blur: sharpness of one view in parts of the other's, as variance of the Laplacian.
        constant_rows: rows of one value at the upper or lower border.
        behind: share of matches that a calibration puts behind the cameras.
    """

    least_matches: int = 30
    least_keypoints: int = 60
    identical: float = 0.5
    rows_warning: float = 1.0
    rows_unusable: float = 2.0
    component: float = 0.5
    scatter_warning: float = 1.0
    scatter_unusable: float = 2.0
    order: float = -0.5
    swapped_share: float = 0.2
    swapped_reach: float = -2.0
    toed_in: float = -1.0
    toed_in_unusable: float = 0.2
    vertical_rig_columns: float = 2.5
    vertical_rig_rows: float = 5.0
    range_part: float = 0.9
    least_gain: float = 0.6
    most_gain: float = 1.6
    clipped: float = 0.2
    bit_depth: float = 1 / 8
    blur: float = 1 / 4
    constant_rows: int = 2
    behind: float = 0.02


THRESHOLDS = Thresholds()
