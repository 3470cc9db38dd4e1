"""Disparity in colours."""

import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.data.images import to_uint8
from stereokit.data.inputs import as_array
from stereokit.errors import ConfigError, InputError
from stereokit.registry import suggest

__all__ = ["colorize", "overlay", "robust_range"]

Picture = npt.NDArray[np.uint8]


FloatMap = npt.NDArray[np.float32]


_COLORMAPS: dict[str, int] = {
    name.removeprefix("COLORMAP_").lower(): getattr(cv2, name)
    for name in sorted(dir(cv2))
    if name.startswith("COLORMAP_")
}


def robust_range(*disparities: npt.ArrayLike, percentiles: tuple[float, float] = (1.0, 99.0)) -> tuple[float, float]:
    """The range of values that colours should span, less a few outliers.

    Several maps give one range for all of them, so that a prediction and its truth can be compared by colour.

    Args:
        disparities: maps, (H, W) each; their non-finite pixels are left out.
        percentiles: of the finite pixels, the lower and the upper end.

    Returns:
        (lo, hi) with lo < hi. (0, 1) where no pixel is finite.

    Raises:
        InputError: a map that is not (H, W), or no map at all.

    >>> robust_range(np.full((4, 6), 7.0))
    (6.5, 7.5)
    """
    if not disparities:
        raise InputError("robust_range was given no map; expected at least one disparity map, (H, W)")
    maps = [as_map(disparity, "disparity") for disparity in disparities]
    values = np.concatenate([m[np.isfinite(m)] for m in maps])
    if values.size == 0:
        return 0.0, 1.0
    lo, hi = (float(v) for v in np.percentile(values, percentiles))
    # A constant map gets the middle of the colours. The margin has to survive float32 at any magnitude.
    margin = max(0.5, abs(lo) * 1e-5)
    return (lo, hi) if hi - lo > 1e-5 * margin else (lo - margin, hi + margin)


def colorize(
    disparity: npt.ArrayLike, *, value_range: tuple[float, float] | None = None, colormap: str = "turbo"
) -> Picture:
    """Colours for a disparity map; non-finite pixels are black.

    Args:
        disparity: (H, W), in pixels.
        value_range: (lo, hi), the disparities at both ends of the colours; values beyond them take the end's
            colour. `robust_range` of the map where it is not given.
        colormap: an OpenCV colour map's name in lower case, such as "turbo", "viridis", "magma" or "jet".

    Returns:
        (H, W, 3), uint8, RGB.

    Raises:
        InputError: a map that is not (H, W), or a range without lo < hi.
        ConfigError: an unknown colour map.

    >>> disparity = np.array([[10.0, 20.0, np.nan]])
    >>> colorize(disparity, value_range=(10, 20), colormap="magma").tolist()
    [[[0, 0, 4], [252, 253, 191], [0, 0, 0]]]
    """
    disparity = as_map(disparity, "disparity")
    lo, hi = checked_range(value_range) if value_range is not None else robust_range(disparity)
    known = np.isfinite(disparity)
    level = (np.where(known, disparity, lo).astype(np.float64) - lo) / (hi - lo)
    picture = color_table(colormap)[to_uint8(level)]
    picture[~known] = 0
    return picture


def overlay(
    image: npt.ArrayLike,
    disparity: npt.ArrayLike,
    *,
    opacity: float = 0.5,
    value_range: tuple[float, float] | None = None,
    colormap: str = "turbo",
) -> Picture:
    """The left image under the colours of its disparity; where the disparity is unknown, the image alone.

    Args:
        image: (H, W, 3), RGB, uint8 or float in [0, 1].
        disparity: (H, W), in pixels.
        opacity: of the colours, 0 (only the image) to 1 (only the colours).
        value_range: as for `colorize`.
        colormap: as for `colorize`.

    Returns:
        (H, W, 3), uint8, RGB.

    Raises:
        InputError: an image or a map of the wrong shape, type or size, or an opacity outside [0, 1].
        ConfigError: an unknown colour map.

    >>> image = np.full((1, 2, 3), 100, np.uint8)
    >>> overlay(image, [[10.0, np.nan]], value_range=(0, 10), colormap="bone", opacity=0.2).tolist()
    [[[131, 131, 131], [100, 100, 100]]]
    """
    array, values = as_array(image), as_map(disparity, "disparity")
    if array.shape != (*values.shape, 3) or (array.dtype != np.uint8 and array.dtype.kind != "f"):
        raise InputError(
            f"image has shape {array.shape} and type {array.dtype}; expected RGB, uint8 or float in [0, 1], "
            f"of the disparity's size: {(*values.shape, 3)}"
        )
    if not 0 <= opacity <= 1:
        raise InputError(f"opacity is {opacity}; expected 0 (only the image) to 1 (only the colours)")
    below = array.astype(np.float32) * (1 if array.dtype == np.uint8 else 255)
    if not (below.min() >= 0 and below.max() <= 255):
        raise InputError(f"a float image spans {array.min():g} to {array.max():g}; expected values in [0, 1]")
    colors = colorize(values, value_range=value_range, colormap=colormap)
    weight = (opacity * np.isfinite(values))[..., None]
    return np.rint(weight * colors + (1 - weight) * below).astype(np.uint8)


def color_table(name: str) -> Picture:
    """The 256 RGB colours of an OpenCV colour map, (256, 3)."""
    if name not in _COLORMAPS:
        raise ConfigError(f"unknown colormap {name!r}; {suggest(name, list(_COLORMAPS))}")
    levels = np.arange(256, dtype=np.uint8)[:, None]
    return np.ascontiguousarray(cv2.applyColorMap(levels, _COLORMAPS[name])[:, 0, ::-1])


def checked_range(value_range: tuple[float, float]) -> tuple[float, float]:
    lo, hi = (float(v) for v in value_range)
    if not (math.isfinite(lo) and math.isfinite(hi) and lo < hi):
        raise InputError(f"value_range is ({lo:g}, {hi:g}); expected two finite numbers with lo < hi, such as (0, 192)")
    return lo, hi


def as_map(values: Any, name: str) -> FloatMap:
    array = as_array(values)
    if array.ndim != 2 or 0 in array.shape or array.dtype.kind not in "fiub":
        raise InputError(
            f"{name} has shape {array.shape} and type {array.dtype}; expected one map of numbers, (H, W)"
            + (f": take {name}[0]" if array.ndim == 3 and array.shape[0] == 1 else "")
        )
    return array.astype(np.float32)


def as_mask(values: Any, name: str, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    array = as_array(values)
    if array.dtype != bool or array.shape != shape:
        raise InputError(f"{name} is {array.dtype} of shape {array.shape}; expected bool, {shape}")
    return array
