"""Augmentation that moves pixels: crop, scale, flip with swap, vertical jitter.

Each function takes a `StereoSample` and gives a new one in which x_right = x_left - d holds as before. Ground
truth is never interpolated: every known value in the result is one measured value, scaled where the image
was.
"""

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.data.datasets.dataset import Mask, StereoSample
from stereokit.data.disparity_arrays import Disparity
from stereokit.errors import InputError

__all__ = [
    "crop",
    "flip_and_swap",
    "random_crop",
    "random_scale",
    "scale",
    "shift_right_view",
    "vertical_jitter",
]


def crop(sample: StereoSample, *, top: int, left: int, height: int, width: int) -> StereoSample:
    """The same window of both views.

    Disparity does not change. Pixels whose match lies left of the window leave the mask of non-occluded ones.

    Raises:
        InputError: the window does not lie within the images.

    >>> pair = StereoSample("a", np.zeros((4, 8, 3), np.uint8), np.zeros((4, 8, 3), np.uint8))
    >>> crop(pair, top=1, left=2, height=2, width=5).left.shape
    (2, 5, 3)
    """
    rows, columns = sample.left.shape[:2]
    if top < 0 or left < 0 or not (0 < height <= rows - top and 0 < width <= columns - left):
        raise InputError(
            f"pair {sample.name!r}: a window of {width} x {height} at ({left}, {top}) does not lie "
            f"within the image of {columns} x {rows}"
        )

    def window(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.ascontiguousarray(values[top : top + height, left : left + width])

    disparity = None if sample.disparity is None else window(sample.disparity)
    nonocc = None if sample.nonocc is None else window(sample.nonocc)
    if nonocc is not None and disparity is not None:
        nonocc &= ~(np.arange(width) - disparity < 0)
    camera = sample.calibration
    return replace(
        sample,
        left=window(sample.left),
        right=window(sample.right),
        disparity=disparity,
        nonocc=nonocc,
        objects=None if sample.objects is None else window(sample.objects),
        calibration=camera
        and replace(camera, cx0=camera.cx0 - left, cx1=camera.cx1 - left, width=width, height=height),
    )


def random_crop(sample: StereoSample, rng: np.random.Generator, *, height: int, width: int) -> StereoSample:
    """A window of the given size at a random place, the same in both views.

    Raises:
        InputError: the image is smaller than the window.
    """
    rows, columns = sample.left.shape[:2]
    if height > rows or width > columns:
        raise InputError(
            f"pair {sample.name!r}: a crop of {width} x {height} was asked for, "
            f"the image is {columns} x {rows}; choose a smaller crop, or scale the pair up first"
        )
    top, left = int(rng.integers(rows - height + 1)), int(rng.integers(columns - width + 1))
    return crop(sample, top=top, left=left, height=height, width=width)


def scale(sample: StereoSample, *, height: int, width: int) -> StereoSample:
    """Both views resized, disparity multiplied by the ratio of the widths.

    Images are interpolated. Ground truth is not: each known value goes to the one pixel nearest to its new
    place, so that an enlarged map has gaps, and of several values that fall on one pixel the nearest stays.

    Raises:
        InputError: a size that is not positive.

    >>> image = np.zeros((2, 2, 3), np.uint8)
    >>> scale(StereoSample("a", image, image, np.ones((2, 2), "f4")), height=1, width=1).disparity.tolist()
    [[0.5]]
    """
    rows, columns = sample.left.shape[:2]
    if height < 1 or width < 1:
        raise InputError(f"pair {sample.name!r}: can't be scaled to {width} x {height} pixels")
    if (height, width) == (rows, columns):
        return sample
    ratio = width / columns
    from_rows, nearest_rows = _nearest(rows, height)
    from_columns, nearest_columns = _nearest(columns, width)

    def pick(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return values[np.ix_(from_rows, from_columns)]

    def resize(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        shrinks = height < rows or width < columns
        return cv2.resize(
            image, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        )

    disparity: Disparity | None = None
    if sample.disparity is not None:
        disparity = pick(sample.disparity) * np.float32(ratio)
        disparity[~np.logical_and.outer(nearest_rows, nearest_columns)] = np.nan
    camera = sample.calibration
    return replace(
        sample,
        left=resize(sample.left),
        right=resize(sample.right),
        disparity=disparity,
        nonocc=None if sample.nonocc is None else pick(sample.nonocc),
        objects=None if sample.objects is None else pick(sample.objects),
        calibration=camera
        and replace(
            camera,
            fx=camera.fx * ratio,
            cx0=(camera.cx0 + 0.5) * ratio - 0.5,
            cx1=(camera.cx1 + 0.5) * ratio - 0.5,
            width=width,
            height=height,
        ),
    )


def random_scale(
    sample: StereoSample,
    rng: np.random.Generator,
    *,
    lowest: float = 0.8,
    highest: float = 1.25,
    min_height: int = 1,
    min_width: int = 1,
) -> StereoSample:
    """Both views resized by a random factor, the same in both directions.

    Args:
        sample: the pair.
        rng: source of randomness.
        lowest: smallest factor. The logarithm of the factor is drawn uniformly.
        highest: largest factor.
        min_height: the factor is raised where the result would have fewer rows, so that a crop still fits.
        min_width: the same for columns.

    Raises:
        InputError: not 0 < lowest <= highest.
    """
    if not 0 < lowest <= highest:
        raise InputError(f"random_scale: expected 0 < lowest <= highest, got {lowest} and {highest}")
    rows, columns = sample.left.shape[:2]
    factor = math.exp(rng.uniform(math.log(lowest), math.log(highest)))
    factor = max(factor, min_height / rows, min_width / columns)
    return scale(
        sample, height=max(round(rows * factor), min_height), width=max(round(columns * factor), min_width)
    )


def flip_and_swap(sample: StereoSample) -> StereoSample:
    """The pair in a mirror: the mirrored right view becomes the left one, the mirrored left view the right
    one.

    Its ground truth belongs to the old right view, and is the old ground truth carried there: the value d of
    column x goes to the column nearest to x - d. Pixels that are hidden there are left out: those not in the
    mask of non-occluded pixels where there is one, else those behind another known surface. What only the
    right view saw is unknown, and without a mask so is what that hides.

    >>> image = np.zeros((1, 4, 3), np.uint8)
    >>> pair = StereoSample("a", image, image, np.array([[np.nan, 1, 1, np.nan]], np.float32))
    >>> flip_and_swap(pair).disparity.tolist()
    [[nan, nan, 1.0, 1.0]]
    """
    height, width = sample.left.shape[:2]
    disparity = nonocc = objects = None
    if sample.disparity is not None:
        rows, columns, places = _seen_from_right(sample.disparity, sample.nonocc)
        disparity = np.full((height, width), np.nan, np.float32)
        disparity[rows, width - 1 - places] = sample.disparity[rows, columns]
        nonocc = np.isfinite(disparity) if sample.nonocc is not None else None
        if sample.objects is not None:
            objects = np.zeros((height, width), np.uint8)
            objects[rows, width - 1 - places] = sample.objects[rows, columns]
    camera = sample.calibration
    return replace(
        sample,
        left=np.ascontiguousarray(sample.right[:, ::-1]),
        right=np.ascontiguousarray(sample.left[:, ::-1]),
        disparity=disparity,
        nonocc=nonocc,
        objects=objects,
        calibration=camera and replace(camera, cx0=width - 1 - camera.cx1, cx1=width - 1 - camera.cx0),
    )


def shift_right_view(sample: StereoSample, *, down: float) -> StereoSample:
    """The right view moved down by some pixels, its border repeated: an error of rectification.

    x_right = x_left - d still holds; the match is `down` rows lower.
    """
    height, width = sample.right.shape[:2]
    move = np.array([[1, 0, 0], [0, 1, down]], np.float64)
    shifted: npt.NDArray[Any] = cv2.warpAffine(
        sample.right, move, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return replace(sample, right=shifted)


def vertical_jitter(sample: StereoSample, rng: np.random.Generator, *, largest: float = 1.5) -> StereoSample:
    """The right view moved up or down by up to `largest` pixels, drawn uniformly.

    It teaches a network to bear the small errors of rectification that real cameras have.
    """
    return shift_right_view(sample, down=rng.uniform(-largest, largest))


def _nearest(size: int, new_size: int) -> tuple[npt.NDArray[np.intp], Mask]:
    """For each new pixel on an axis the nearest old one, and whether it is that one's nearest new pixel."""
    new = np.arange(new_size)
    old = np.minimum(np.floor((new + 0.5) * size / new_size), size - 1).astype(np.intp)
    back = np.minimum(np.floor((old + 0.5) * new_size / size), new_size - 1)
    return old, back == new


def _seen_from_right(disparity: Disparity, nonocc: Mask | None) -> tuple[npt.NDArray[np.intp], ...]:
    """Rows and columns of the left pixels that the right view sees, and their columns there."""
    width = disparity.shape[1]
    known = np.isfinite(disparity)
    if nonocc is not None:
        known &= nonocc
    rows, columns = np.nonzero(known)
    values = disparity[rows, columns]
    exact = columns - values
    inside = (exact >= 0) & (exact <= width - 1)
    rows, columns, values, exact = rows[inside], columns[inside], values[inside], exact[inside]
    # A surface covers both columns that its pixel falls between, which closes the gaps of a stretched one.
    nearest = np.full(disparity.shape, -np.inf, np.float32)
    for column in (np.floor(exact), np.ceil(exact)):
        np.maximum.at(nearest, (rows, column.astype(np.intp)), values)
    places = np.rint(exact).astype(np.intp)
    seen = values > nearest[rows, places] - 1
    # The nearer surface is written last, over the farther one.
    order = np.argsort(values[seen], kind="stable")
    return rows[seen][order], columns[seen][order], places[seen][order]
