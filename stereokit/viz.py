"""Pictures of disparity: colours with a scale, errors, overlays, and the distributions behind an estimate.

Every picture is RGB, uint8, (H, W, 3). Maps may be numpy arrays or tensors on any device, (H, W), in pixels.
"""

import math
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.errors import ConfigError, InputError
from stereokit.registry import suggest

__all__ = ["colorize", "picture_with_scale", "robust_range"]

Picture = npt.NDArray[np.uint8]
FloatMap = npt.NDArray[np.float32]

_COLORMAPS: dict[str, int] = {
    name.removeprefix("COLORMAP_").lower(): getattr(cv2, name)
    for name in sorted(dir(cv2))
    if name.startswith("COLORMAP_")
}


def robust_range(
    *disparities: npt.ArrayLike, percentiles: tuple[float, float] = (1.0, 99.0)
) -> tuple[float, float]:
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
    maps = [_as_map(disparity, "disparity") for disparity in disparities]
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
    disparity = _as_map(disparity, "disparity")
    lo, hi = _checked_range(value_range) if value_range is not None else robust_range(disparity)
    known = np.isfinite(disparity)
    level = (np.where(known, disparity, lo).astype(np.float64) - lo) / (hi - lo)
    picture = _color_table(colormap)[np.rint(np.clip(level, 0, 1) * 255).astype(np.uint8)]
    picture[~known] = 0
    return picture


def picture_with_scale(
    disparity: npt.ArrayLike,
    *,
    value_range: tuple[float, float] | None = None,
    colormap: str = "turbo",
    unit: str = "px",
) -> Picture:
    """The colours of a disparity map above a bar that says what they mean.

    Map and bar stand on white. The text grows with the map but never falls below a legible size, and a map
    that is narrower than the bar needs is centred over it.

    Args:
        disparity: (H, W), in pixels.
        value_range: as for `colorize`.
        colormap: as for `colorize`.
        unit: what stands behind the last number of the scale.

    Returns:
        (H + the bar's height, max(W, the bar's width), 3), uint8, RGB. The map's pixels are those of
        `colorize`.

    Raises:
        InputError: a map that is not (H, W), or a range without lo < hi.
        ConfigError: an unknown colour map.

    >>> picture = picture_with_scale(np.linspace(0, 64, 32 * 320).reshape(32, 320))
    >>> picture.shape[1], picture.dtype
    (320, dtype('uint8'))
    """
    disparity = _as_map(disparity, "disparity")
    value_range = _checked_range(value_range) if value_range is not None else robust_range(disparity)
    picture = colorize(disparity, value_range=value_range, colormap=colormap)
    height, width = disparity.shape
    text_height = max(10, round(math.sqrt(height * width) / 50))
    scale = _scale(width, value_range, _color_table(colormap), text_height=text_height, unit=unit)
    canvas = np.full((height + scale.shape[0], scale.shape[1], 3), 255, np.uint8)
    left = (scale.shape[1] - width) // 2
    canvas[:height, left : left + width] = picture
    canvas[height:] = scale
    return canvas


def _scale(
    at_least: int, value_range: tuple[float, float], colors: Picture, *, text_height: int, unit: str
) -> Picture:
    """A horizontal colour bar over as many round numbers as fit, `at_least` so many pixels wide, on white."""
    lo, hi = value_range
    gap = text_height // 2
    unit_ink = _ink(unit, text_height)
    for step, decimals in _round_steps(hi - lo):
        ticks = [n * step for n in range(math.ceil(lo / step - 1e-9), math.floor(hi / step + 1e-9) + 1)]
        inks = [_ink(f"{tick:.{decimals}f}", text_height) for tick in ticks]
        label_width = max(ink.shape[1] for ink in inks)
        left = gap + label_width // 2
        right = max(left, 2 * gap + unit_ink.shape[1])
        needed = math.ceil((label_width + 3 * text_height) * (hi - lo) / step)
        if needed <= at_least - left - right:
            break
    # The coarsest numbers are shown even where the map is too narrow for them.
    span = max(needed, at_least - left - right)
    scale = np.full((5 * gap + 2 * text_height, left + span + right, 3), 255, np.uint8)
    bar_top, bar_bottom = gap, gap + text_height
    text_top = bar_bottom + 2 * gap
    scale[bar_top:bar_bottom, left : left + span] = colors[np.linspace(0, 255, span).round().astype(int)]
    _stamp(scale, unit_ink, top=bar_top, left=left + span + gap)
    for tick, ink in zip(ticks, inks, strict=True):
        x = left + min(span - 1, max(0, round((tick - lo) / (hi - lo) * (span - 1))))
        scale[bar_bottom : bar_bottom + gap, x] = 0
        _stamp(scale, ink, top=text_top, left=x - ink.shape[1] // 2)
    return scale


def _round_steps(length: float) -> list[tuple[float, int]]:
    """Steps of 1, 2 or 5 times a power of ten, finest first, that divide a length into 2 to 50, with decimals."""
    power = math.floor(math.log10(length / 50))
    steps = [(m * 10.0**p, max(0, -p)) for p in range(power, power + 3) for m in (1, 2, 5)]
    return [(step, decimals) for step, decimals in steps if length / 50 <= step <= length / 2]


def _ink(text: str, digit_height: int) -> npt.NDArray[np.float32]:
    """How much of each pixel a line of text covers, 0 to 1; the digits fill the first `digit_height` rows.

    Drawn large and averaged down, so that it looks alike under the fonts of OpenCV 4 and 5.
    """
    font, scale, thickness = cv2.FONT_HERSHEY_SIMPLEX, 3.0, 7
    (width, height), below = cv2.getTextSize("0" + text, font, scale, thickness)
    large = np.zeros((2 * height + below, width + 2 * height), np.uint8)
    baseline = (height // 2, height + height // 2)
    digit = cv2.putText(large.copy(), "0", baseline, font, scale, 255, thickness, cv2.LINE_AA)
    rows = np.flatnonzero(digit.any(axis=1))
    drawn = cv2.putText(large, text, baseline, font, scale, 255, thickness, cv2.LINE_AA)
    columns = np.flatnonzero(drawn.any(axis=0))
    if columns.size == 0:
        return np.zeros((digit_height, 1), np.float32)
    drawn = drawn[rows[0] :, columns[0] : columns[-1] + 1]
    shrink = digit_height / (rows[-1] + 1 - rows[0])
    size = (max(1, round(drawn.shape[1] * shrink)), round(drawn.shape[0] * shrink))
    return np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA), np.float32) / 255


def _stamp(picture: Picture, ink: npt.NDArray[np.float32], *, top: int, left: int) -> None:
    """Puts black text on a picture, in place; what sticks out below is left off."""
    area = picture[top : top + ink.shape[0], left : left + ink.shape[1]]
    area[:] = np.rint(area * (1 - ink[: area.shape[0], :, None])).astype(np.uint8)


def _color_table(name: str) -> Picture:
    """The 256 RGB colours of an OpenCV colour map, (256, 3)."""
    if name not in _COLORMAPS:
        raise ConfigError(f"unknown colormap {name!r}; {suggest(name, list(_COLORMAPS))}")
    levels = np.arange(256, dtype=np.uint8)[:, None]
    return np.ascontiguousarray(cv2.applyColorMap(levels, _COLORMAPS[name])[:, 0, ::-1])


def _checked_range(value_range: tuple[float, float]) -> tuple[float, float]:
    lo, hi = (float(v) for v in value_range)
    if not (math.isfinite(lo) and math.isfinite(hi) and lo < hi):
        raise InputError(
            f"value_range is ({lo:g}, {hi:g}); expected two finite numbers with lo < hi, such as (0, 192)"
        )
    return lo, hi


def _as_array(values: Any) -> npt.NDArray[Any]:
    """A numpy array of an array or of a tensor, wherever the tensor lives."""
    return np.asarray(values.detach().float().cpu().numpy() if hasattr(values, "detach") else values)


def _as_map(values: Any, name: str) -> FloatMap:
    array = _as_array(values)
    if array.ndim != 2 or 0 in array.shape or array.dtype.kind not in "fiub":
        raise InputError(
            f"{name} has shape {array.shape} and type {array.dtype}; expected one map of numbers, (H, W)"
            + (f": take {name}[0]" if array.ndim == 3 and array.shape[0] == 1 else "")
        )
    return array.astype(np.float32)
