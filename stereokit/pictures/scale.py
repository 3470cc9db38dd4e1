"""Colours with a scale, captions."""

import math

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.pictures.colors import Picture, as_map, checked_range, color_table, colorize, robust_range

__all__ = ["captioned", "picture_with_scale"]


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
    disparity = as_map(disparity, "disparity")
    value_range = checked_range(value_range) if value_range is not None else robust_range(disparity)
    picture = colorize(disparity, value_range=value_range, colormap=colormap)
    height, width = disparity.shape
    text_height = max(10, round(math.sqrt(height * width) / 50))
    scale = _scale(width, value_range, color_table(colormap), text_height=text_height, unit=unit)
    canvas = np.full((height + scale.shape[0], scale.shape[1], 3), 255, np.uint8)
    left = (scale.shape[1] - width) // 2
    canvas[:height, left : left + width] = picture
    canvas[height:] = scale
    return canvas


def captioned(picture: Picture, text: str) -> Picture:
    """A picture with a line of text in its upper left corner, black on white; what is too long is cut off.

    >>> captioned(np.zeros((40, 90, 3), np.uint8), "error").shape
    (40, 90, 3)
    """
    height = max(8, round(math.sqrt(picture.shape[0] * picture.shape[1]) / 40))
    gap = height // 2
    ink = _ink(text, height)
    sign = np.full((ink.shape[0] + 2 * gap, ink.shape[1] + 2 * gap, 3), 255, np.uint8)
    _stamp(sign, ink, top=gap, left=gap)
    captioned = picture.copy()
    corner = captioned[: sign.shape[0], : sign.shape[1]]
    corner[:] = sign[: corner.shape[0], : corner.shape[1]]
    return captioned


def _scale(at_least: int, value_range: tuple[float, float], colors: Picture, *, text_height: int, unit: str) -> Picture:
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
    """Steps of 1, 2, 5 times a power of ten that divide a length into 2 to 50, and their decimals."""
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
    return np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA) / 255, np.float32)


def _stamp(picture: Picture, ink: npt.NDArray[np.float32], *, top: int, left: int) -> None:
    """Puts black text on a picture, in place; what sticks out below is left off."""
    area = picture[top : top + ink.shape[0], left : left + ink.shape[1]]
    area[:] = np.rint(area * (1 - ink[: area.shape[0], :, None])).astype(np.uint8)
