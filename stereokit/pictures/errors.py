"""Errors in KITTI's colours."""

import math

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.errors import InputError
from stereokit.pictures.colors import Picture, as_map, as_mask

__all__ = ["KITTI_ERROR_COLORS", "error_picture"]

KITTI_ERROR_COLORS: tuple[tuple[float, tuple[int, int, int]], ...] = (
    (0.1875, (49, 54, 149)),
    (0.375, (69, 117, 180)),
    (0.75, (116, 173, 209)),
    (1.5, (171, 217, 233)),
    (3.0, (224, 243, 248)),
    (6.0, (254, 224, 144)),
    (12.0, (253, 174, 97)),
    (24.0, (244, 109, 67)),
    (48.0, (215, 48, 39)),
    (math.inf, (165, 0, 38)),
)
"""The error colours of the KITTI 2015 devkit, from right to wrong: (up to this error in px, RGB)."""


NO_PREDICTION_COLOR = (255, 0, 255)


def error_picture(
    prediction: npt.ArrayLike,
    truth: npt.ArrayLike,
    *,
    occluded: npt.ArrayLike | None = None,
    dilate: int = 1,
    min_disparity: float = 0,
) -> Picture:
    """Where a prediction is wrong, and by how much, in the colours of the KITTI 2015 devkit.

    The colour is that of `KITTI_ERROR_COLORS` for e = min(|d - d*|, 60 |d - d*| / |d*|): blue up to e = 3,
    yellow to red beyond. So the warm pixels are exactly the outliers that D1 counts (> 3 px and > 5 % of the
    truth). Pixels without a prediction (not finite) are magenta, pixels without ground truth black.

    Args:
        prediction: (H, W), in pixels.
        truth: (H, W), in pixels; 0 or non-finite is unknown.
        occluded: (H, W), bool: pixels that the right image does not see; drawn half as bright.
        dilate: how far pixels of sparse ground truth spread into unknown neighbours; the worst one wins.
            Pixels with ground truth keep their own colour. 0 spreads nothing.
        min_disparity: of the truth that is known, in pixels; below 0 makes 0 a disparity like any other.

    Returns:
        (H, W, 3), uint8, RGB.

    Raises:
        InputError: maps that are not (H, W), differ in size or are of the wrong type.

    Source: the KITTI 2015 devkit's colour table and normalised error, `error_colormap.m` and
    `disp_error_image.m`, https://www.cvlibs.net/datasets/kitti/eval_scene_flow.php.

    >>> error_picture([[50.0, 54.0, 50.0]], [[50.0, 50.0, 0.0]], dilate=0).tolist()
    [[[49, 54, 149], [254, 224, 144], [0, 0, 0]]]
    """
    predicted, true = as_map(prediction, "prediction"), as_map(truth, "truth")
    if predicted.shape != true.shape:
        raise InputError(f"prediction is {predicted.shape} and truth {true.shape}; expected two maps of one size")
    known = np.isfinite(true) & (true >= min_disparity if min_disparity else true > 0)
    invalid = ~np.isfinite(predicted)
    # In float64 the difference of two float32 numbers is exact, so that an error of exactly 3 px stays blue.
    true = np.where(known, true, 1).astype(np.float64)
    absolute = np.abs(np.where(invalid, true, predicted) - true)
    with np.errstate(divide="ignore", invalid="ignore"):
        # fmin, for a truth of 0
        error = np.fmin(absolute, 60 * absolute / np.abs(true))
    limits, colors = zip(*KITTI_ERROR_COLORS, strict=True)
    # 0 is "unknown", 1 to 10 the table's rows, 11 "no prediction": the worst is the largest.
    colors = ((0, 0, 0), *colors, NO_PREDICTION_COLOR)
    level = (1 + np.searchsorted(limits, error, side="left")).astype(np.uint8)
    level[invalid] = len(colors) - 1
    level[~known] = 0
    # Each level is there twice: dark, then bright.
    table = np.array([shade for color in colors for shade in (np.array(color) // 2, color)], np.uint8)
    dark = np.zeros(true.shape, bool) if occluded is None else as_mask(occluded, "occluded", true.shape)
    level = np.where(dark, 2 * level, 2 * level + 1).astype(np.uint8)
    if dilate > 0:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * dilate + 1, 2 * dilate + 1))
        level = np.where(known, level, cv2.dilate(level, disc))
    return table[level]
