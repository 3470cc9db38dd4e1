"""Augmentation that changes colours, and hides a part of the right view; no pixel moves."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from stereokit.data.datasets.dataset import StereoSample
from stereokit.errors import InputError

__all__ = ["adjust_colour", "colour_jitter", "occlude_right_view", "random_occlusion"]

_LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # of ITU-R BT.601


def adjust_colour(
    image: npt.NDArray[Any],
    *,
    brightness: float = 1.0,
    contrast: float = 1.0,
    saturation: float = 1.0,
    gamma: float = 1.0,
) -> npt.NDArray[Any]:
    """An image with other colours, clipped to its range.

    With v in [0, 1]: saturation blends with the grey value, v = grey + saturation (v - grey); contrast with
    the mean of the image, v = mean + contrast (v - mean); then v = (brightness v) ^ gamma. 1 leaves things as
    they are.

    Args:
        image: RGB (H, W, 3), uint8 or float32 in [0, 1].
        brightness: factor.
        contrast: factor.
        saturation: factor.
        gamma: exponent.

    Returns:
        An image of the same shape and type.

    Raises:
        InputError: a factor below 0, or a gamma that is not positive.

    >>> adjust_colour(np.full((1, 1, 3), 100, np.uint8), brightness=1.5)[0, 0].tolist()
    [150, 150, 150]
    """
    if min(brightness, contrast, saturation) < 0 or gamma <= 0:
        raise InputError(
            f"adjust_colour: expected factors of at least 0 and a positive gamma, got {brightness=}, "
            f"{contrast=}, {saturation=}, {gamma=}"
        )
    is_bytes = image.dtype == np.uint8
    values = image.astype(np.float32) / 255 if is_bytes else image
    grey = sum(weight * values[..., channel : channel + 1] for channel, weight in enumerate(_LUMA))
    values = grey + np.float32(saturation) * (values - grey)
    mean = grey.mean(dtype=np.float32)
    values = (mean + np.float32(contrast) * (values - mean)) * np.float32(brightness)
    values = np.clip(values, 0, 1) ** np.float32(gamma)
    if is_bytes:
        values = np.rint(values * 255).astype(np.uint8)
    return np.ascontiguousarray(values)


def colour_jitter(
    sample: StereoSample,
    rng: np.random.Generator,
    *,
    brightness: float = 0.4,
    contrast: float = 0.4,
    saturation: float = 0.4,
    gamma: float = 0.2,
    apart: bool = False,
) -> StereoSample:
    """Random colours.

    Args:
        sample: the pair.
        rng: source of randomness.
        brightness: the factor is drawn from [1 - brightness, 1 + brightness].
        contrast: likewise.
        saturation: likewise.
        gamma: likewise.
        apart: draw for each view by itself, as cameras with other exposures would differ; else both change
            alike.

    Raises:
        InputError: a range beyond [0, 1), which would turn a view black or inside out.
    """
    ranges = {"brightness": brightness, "contrast": contrast, "saturation": saturation, "gamma": gamma}
    if not all(0 <= half < 1 for half in ranges.values()):
        raise InputError(f"colour_jitter: expected ranges from 0 to below 1, got {ranges}")

    def draw() -> dict[str, float]:
        return {key: rng.uniform(1 - half, 1 + half) for key, half in ranges.items()}

    if apart:
        return replace(sample, left=adjust_colour(sample.left, **draw()), right=adjust_colour(sample.right, **draw()))
    # As one image, so that contrast turns around one mean and equal colours stay equal.
    both = adjust_colour(np.concatenate((sample.left, sample.right)), **draw())
    left, right = np.split(both, 2)
    return replace(sample, left=left, right=right)


def occlude_right_view(sample: StereoSample, *, top: int, left: int, height: int, width: int) -> StereoSample:
    """A rectangle of the right view filled with the view's mean colour, as if something stood before that
    camera.

    The ground truth stays; pixels whose match is hidden leave the mask of non-occluded ones. The right view's own
    ground truth is unknown in the rectangle. The part of the rectangle that lies outside the image is ignored.
    """
    right = sample.right.copy()
    rows, columns = slice(max(top, 0), max(top + height, 0)), slice(max(left, 0), max(left + width, 0))
    mean = right.reshape(-1, 3).mean(axis=0)
    right[rows, columns] = np.rint(mean) if right.dtype == np.uint8 else mean
    nonocc = sample.nonocc
    if nonocc is not None and sample.disparity is not None:
        match = np.arange(right.shape[1]) - sample.disparity
        hidden = np.zeros_like(nonocc)
        # A match between two columns needs both of them.
        hidden[rows] = ((match > left - 1) & (match < left + width))[rows]
        nonocc = nonocc & ~hidden
    right_disparity, right_nonocc = sample.right_disparity, sample.right_nonocc
    if right_disparity is not None:
        right_disparity = right_disparity.copy()
        right_disparity[rows, columns] = np.nan
    if right_nonocc is not None:
        right_nonocc = right_nonocc.copy()
        right_nonocc[rows, columns] = False
    return replace(sample, right=right, nonocc=nonocc, right_disparity=right_disparity, right_nonocc=right_nonocc)


def random_occlusion(
    sample: StereoSample, rng: np.random.Generator, *, smallest: int = 50, largest: int = 100
) -> StereoSample:
    """A rectangle of random place and size in the right view filled with the view's mean colour.

    Args:
        sample: the pair.
        rng: source of randomness.
        smallest: side of the rectangle in pixels.
        largest: the same. It is centred anywhere in the image, so that less may be hidden at the border.

    Raises:
        InputError: not 0 < smallest <= largest.

    Source: Yang et al., Hierarchical deep stereo matching on high-resolution images, CVPR 2019.
    """
    if not 0 < smallest <= largest:
        raise InputError(f"random_occlusion: expected 0 < smallest <= largest, got {smallest} and {largest}")
    rows, columns = sample.right.shape[:2]
    height, width = (int(side) for side in rng.integers(smallest, largest + 1, size=2))
    top, left = int(rng.integers(rows)) - height // 2, int(rng.integers(columns)) - width // 2
    return occlude_right_view(sample, top=top, left=left, height=height, width=width)
