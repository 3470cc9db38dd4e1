"""Augmentation that moves pixels: crop, scale, flip with swap, vertical jitter.

Each function takes a `StereoSample` and gives a new one in which x_right = x_left - d holds as before. Ground
truth is never interpolated: every known value in the result is one measured value, scaled where the image
was.
"""

import math
from dataclasses import replace
from typing import Any, TypeVar, overload

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.data.datasets.dataset import Mask, StereoSample
from stereokit.data.disparity_arrays import Disparity
from stereokit.errors import InputError

T = TypeVar("T", bound=np.generic)

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

    Disparity does not change. Pixels whose match lies outside of the window leave the masks of non-occluded ones.

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
    right_disparity = None if sample.right_disparity is None else window(sample.right_disparity)
    nonocc = None if sample.nonocc is None else window(sample.nonocc)
    right_nonocc = None if sample.right_nonocc is None else window(sample.right_nonocc)
    if nonocc is not None and disparity is not None:
        nonocc = nonocc & ~(np.arange(width) - disparity < 0)
    if right_nonocc is not None and right_disparity is not None:
        right_nonocc = right_nonocc & ~(np.arange(width) + right_disparity > width - 1)
    camera = sample.calibration
    return replace(
        sample,
        left=window(sample.left),
        right=window(sample.right),
        disparity=disparity,
        nonocc=nonocc,
        objects=None if sample.objects is None else window(sample.objects),
        calibration=camera and camera.sized(rows, columns).cropped(top=top, left=left, height=height, width=width),
        right_disparity=right_disparity,
        right_nonocc=right_nonocc,
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
        # one after the other: where one side grows, OpenCV's means over areas repeat pixels
        shrunk = cv2.resize(image, (min(width, columns), min(height, rows)), interpolation=cv2.INTER_AREA)
        return cv2.resize(shrunk, (width, height), interpolation=cv2.INTER_LINEAR)

    def place(disparity: Disparity) -> Disparity:
        placed: Disparity = pick(disparity) * np.float32(ratio)
        placed[~np.logical_and.outer(nearest_rows, nearest_columns)] = np.nan
        return placed

    camera = sample.calibration
    return replace(
        sample,
        left=resize(sample.left),
        right=resize(sample.right),
        disparity=None if sample.disparity is None else place(sample.disparity),
        nonocc=None if sample.nonocc is None else pick(sample.nonocc),
        objects=None if sample.objects is None else pick(sample.objects),
        calibration=camera and camera.sized(rows, columns).scaled(height=height, width=width, stretch=True),
        right_disparity=None if sample.right_disparity is None else place(sample.right_disparity),
        right_nonocc=None if sample.right_nonocc is None else pick(sample.right_nonocc),
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
    return scale(sample, height=max(round(rows * factor), min_height), width=max(round(columns * factor), min_width))


def flip_and_swap(sample: StereoSample) -> StereoSample:
    """The pair in a mirror: the mirrored right view becomes the left one, the mirrored left view the right
    one.

    With ground truth for the right view, the mirrored right map becomes the left one and the mirrored left map the
    right one, masks alike: twice is the pair itself, but for objects.

    Without it, the old ground truth is carried to the right view: the value d of column x goes to the column nearest
    to x - d. Pixels that are hidden there are left out: those not in the mask of non-occluded pixels where there is
    one, else those behind another known surface. What only the right view saw is unknown, and without a mask so is
    what that hides. Objects, which belong to the left view, are always carried so.

    Source: Bangunharcana et al., Correlate-and-Excite, IROS 2021 (the flip among its augmentations).

    >>> image = np.zeros((1, 4, 3), np.uint8)
    >>> pair = StereoSample("a", image, image, np.array([[np.nan, 1, 1, np.nan]], np.float32))
    >>> flip_and_swap(pair).disparity.tolist()
    [[nan, nan, 1.0, 1.0]]
    """
    height, width = sample.left.shape[:2]
    disparity = nonocc = objects = right_disparity = right_nonocc = None
    if sample.disparity is not None and (sample.right_disparity is None or sample.objects is not None):
        rows, columns, places = _seen_from_right(sample.disparity, sample.nonocc)
        disparity = np.full((height, width), np.nan, np.float32)
        disparity[rows, width - 1 - places] = sample.disparity[rows, columns]
        nonocc = np.isfinite(disparity) if sample.nonocc is not None else None
        if sample.objects is not None:
            objects = np.zeros((height, width), np.uint8)
            objects[rows, width - 1 - places] = sample.objects[rows, columns]
    if sample.right_disparity is not None:
        disparity, right_disparity = _mirrored(sample.right_disparity), _mirrored(sample.disparity)
        nonocc, right_nonocc = _mirrored(sample.right_nonocc), _mirrored(sample.nonocc)
    camera = sample.calibration
    return replace(
        sample,
        left=_mirrored(sample.right),
        right=_mirrored(sample.left),
        disparity=disparity,
        nonocc=nonocc,
        objects=objects,
        calibration=camera and camera.sized(height, width).mirrored(),
        right_disparity=right_disparity,
        right_nonocc=right_nonocc,
    )


def shift_right_view(sample: StereoSample, *, down: float) -> StereoSample:
    """The right view moved down by some pixels, its border repeated: an error of rectification.

    x_right = x_left - d still holds; the match is `down` rows lower. The right view's ground truth moves along by
    whole rows, and is unknown where the border was repeated.
    """
    height, width = sample.right.shape[:2]
    move = np.array([[1, 0, 0], [0, 1, down]], np.float64)
    shifted: npt.NDArray[Any] = cv2.warpAffine(
        sample.right, move, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    rows = np.floor(np.arange(height) - down + 0.5).astype(np.intp)
    outside = (rows < 0) | (rows >= height)
    rows = np.clip(rows, 0, height - 1)
    right_disparity, right_nonocc = sample.right_disparity, sample.right_nonocc
    if right_disparity is not None:
        right_disparity = right_disparity[rows]
        right_disparity[outside] = np.nan
    if right_nonocc is not None:
        right_nonocc = right_nonocc[rows]
        right_nonocc[outside] = False
    return replace(sample, right=shifted, right_disparity=right_disparity, right_nonocc=right_nonocc)


def vertical_jitter(sample: StereoSample, rng: np.random.Generator, *, largest: float = 1.5) -> StereoSample:
    """The right view moved up or down by up to `largest` pixels, drawn uniformly.

    It teaches a network to bear the small errors of rectification that real cameras have.
    """
    return shift_right_view(sample, down=rng.uniform(-largest, largest))


@overload
def _mirrored(values: None) -> None: ...


@overload
def _mirrored(values: npt.NDArray[T]) -> npt.NDArray[T]: ...


def _mirrored(values: npt.NDArray[T] | None) -> npt.NDArray[T] | None:
    return None if values is None else np.ascontiguousarray(values[:, ::-1])


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
