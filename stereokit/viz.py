"""Pictures of disparity: colours with a scale, errors, overlays, and the distributions behind an estimate.

Every picture is RGB, uint8, (H, W, 3). Maps may be numpy arrays or tensors on any device, (H, W), in pixels.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.data.images import to_uint8
from stereokit.errors import ConfigError, InputError
from stereokit.inputs import as_array
from stereokit.registry import suggest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "KITTI_ERROR_COLORS",
    "captioned",
    "colorize",
    "distribution_figure",
    "error_picture",
    "overlay",
    "picture_with_scale",
    "robust_range",
]

Picture = npt.NDArray[np.uint8]
FloatMap = npt.NDArray[np.float32]

_COLORMAPS: dict[str, int] = {
    name.removeprefix("COLORMAP_").lower(): getattr(cv2, name)
    for name in sorted(dir(cv2))
    if name.startswith("COLORMAP_")
}

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
    picture = _color_table(colormap)[to_uint8(level)]
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


def error_picture(
    prediction: npt.ArrayLike,
    truth: npt.ArrayLike,
    *,
    occluded: npt.ArrayLike | None = None,
    dilate: int = 1,
) -> Picture:
    """Where a prediction is wrong, and by how much, in the colours of the KITTI 2015 devkit.

    The colour is that of `KITTI_ERROR_COLORS` for e = min(|d - d*|, 60 |d - d*| / d*): blue up to e = 3,
    yellow to red beyond. So the warm pixels are exactly the outliers that D1 counts (> 3 px and > 5 % of the
    truth). Pixels without a prediction (not finite) are magenta, pixels without ground truth black.

    Args:
        prediction: (H, W), in pixels.
        truth: (H, W), in pixels; 0 or non-finite is unknown.
        occluded: (H, W), bool: pixels that the right image does not see; drawn half as bright.
        dilate: how far pixels of sparse ground truth spread into unknown neighbours; the worst one wins.
            Pixels with ground truth keep their own colour. 0 spreads nothing.

    Returns:
        (H, W, 3), uint8, RGB.

    Raises:
        InputError: maps that are not (H, W), differ in size or are of the wrong type.

    Source: the KITTI 2015 devkit's colour table and normalised error, `error_colormap.m` and
    `disp_error_image.m`, https://www.cvlibs.net/datasets/kitti/eval_scene_flow.php.

    >>> error_picture([[50.0, 54.0, 50.0]], [[50.0, 50.0, 0.0]], dilate=0).tolist()
    [[[49, 54, 149], [254, 224, 144], [0, 0, 0]]]
    """
    predicted, true = _as_map(prediction, "prediction"), _as_map(truth, "truth")
    if predicted.shape != true.shape:
        raise InputError(f"prediction is {predicted.shape} and truth {true.shape}; expected two maps of one size")
    known = np.isfinite(true) & (true > 0)
    invalid = ~np.isfinite(predicted)
    # In float64 the difference of two float32 numbers is exact, so that an error of exactly 3 px stays blue.
    true = np.where(known, true, 1).astype(np.float64)
    absolute = np.abs(np.where(invalid, true, predicted) - true)
    error = np.minimum(absolute, 60 * absolute / true)
    limits, colors = zip(*KITTI_ERROR_COLORS, strict=True)
    # 0 is "unknown", 1 to 10 the table's rows, 11 "no prediction": the worst is the largest.
    colors = ((0, 0, 0), *colors, NO_PREDICTION_COLOR)
    level = (1 + np.searchsorted(limits, error, side="left")).astype(np.uint8)
    level[invalid] = len(colors) - 1
    level[~known] = 0
    # Each level is there twice: dark, then bright.
    table = np.array([shade for color in colors for shade in (np.array(color) // 2, color)], np.uint8)
    dark = np.zeros(true.shape, bool) if occluded is None else _as_mask(occluded, "occluded", true.shape)
    level = np.where(dark, 2 * level, 2 * level + 1).astype(np.uint8)
    if dilate > 0:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * dilate + 1, 2 * dilate + 1))
        level = np.where(known, level, cv2.dilate(level, disc))
    return table[level]


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
    array, values = as_array(image), _as_map(disparity, "disparity")
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


def distribution_figure(
    logits: npt.ArrayLike,
    pixels: Sequence[tuple[int, int]],
    *,
    k: int | None = None,
    stride: int = 1,
    candidates: npt.ArrayLike | None = None,
    probabilities: bool = False,
    estimate: npt.ArrayLike | None = None,
    truth: npt.ArrayLike | None = None,
) -> "Figure":
    """The distribution over disparities at chosen pixels: all candidates, those kept, and what comes out.

    One panel per pixel. Bars are softmax(logits) over all candidates, the k largest in a stronger colour. The
    dashed red line is the estimate, the solid green line the ground truth.

    Args:
        logits: (D', H', W') of one image, larger is better.
        pixels: (x, y) of each panel: column and row in the left image at full resolution.
        k: how many candidates the regression keeps; all of them (soft-argmin) where it is not given.
        stride: full-resolution pixels per cell of the volume, such as 4 for a volume at quarter resolution.
        candidates: disparity of each level in full-resolution pixels, (D',) or (D', H', W'). 0, stride,
            2 stride, ... where it is not given.
        probabilities: whether `logits` already holds probabilities, which sum to 1 over D'.
        estimate: the network's disparity, (H, W). Where it is not given, the expectation over the k
            candidates kept: sum of d * softmax(their logits).
        truth: (H, W); no line where it is 0 or non-finite.

    Returns:
        A matplotlib figure that belongs to no window; `figure.savefig(path)` writes it.

    Raises:
        ConfigError: matplotlib is not installed.
        InputError: volumes or maps of the wrong shape, a pixel outside, a k that is not within 1 and D'.

    Source: the figure of disparity distributions in Bangunharcana et al., "Correlate-and-Excite: Real-Time
    Stereo Matching via Guided Cost Volume Excitation", IROS 2021.

    >>> volume = -((np.arange(48.0)[:, None, None] - 12) ** 2) * np.ones((1, 60, 80))
    >>> figure = distribution_figure(volume, [(100, 50), (200, 120)], k=2, stride=4)  # doctest: +SKIP
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigError(
            'distribution_figure draws with matplotlib, which is not installed; pip install "stereokit[viz]"'
        ) from error

    volume = as_array(logits).astype(np.float64)
    if volume.ndim != 3 or 0 in volume.shape:
        raise InputError(f"logits have shape {volume.shape}; expected those of one image, (D', H', W')")
    levels, rows, columns = volume.shape
    k = levels if k is None else k
    if not 1 <= k <= levels:
        raise InputError(f"k is {k}; expected 1 to {levels}, the number of candidates")
    if probabilities and not (volume.min() >= 0 and np.allclose(volume.sum(axis=0), 1, atol=1e-3)):
        raise InputError("probabilities are negative or do not sum to 1; expected a softmax over D'")
    if stride < 1:
        raise InputError(f"stride is {stride}; expected 1 or more full-resolution pixels per cell")
    disparities = np.arange(levels) * stride if candidates is None else as_array(candidates)
    if disparities.shape not in {(levels,), volume.shape}:
        raise InputError(f"candidates have shape {disparities.shape}; expected {(levels,)} or {volume.shape}")
    maps = {"estimate": estimate, "truth": truth}
    known = {name: _as_map(values, name) for name, values in maps.items() if values is not None}
    width = min([columns * stride, *(m.shape[1] for m in known.values())])
    height = min([rows * stride, *(m.shape[0] for m in known.values())])
    if not pixels:
        raise InputError("no pixel was given; expected at least one (x, y)")
    for x, y in pixels:
        if not (0 <= x < width and 0 <= y < height):
            raise InputError(f"pixel ({x}, {y}) is outside; expected 0 <= x < {width} and 0 <= y < {height}")

    across = min(3, len(pixels))
    down = math.ceil(len(pixels) / across)
    figure = Figure(figsize=(0.5 + 3.6 * across, 0.6 + 2.4 * down), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False).ravel()
    legend: dict[str, Any] = {}
    for panel, (x, y) in zip(panels, pixels, strict=False):
        cell = (slice(None), y // stride, x // stride)
        disparity = (disparities[cell] if disparities.ndim == 3 else disparities).astype(np.float64)
        probability = volume[cell] if probabilities else _softmax(volume[cell])
        if not np.isfinite(probability).all():
            raise InputError(f"the logits at pixel ({x}, {y}) are not finite; expected a number per candidate")
        kept = np.zeros(levels, bool)
        kept[np.argsort(-probability, kind="stable")[:k]] = True
        gaps = np.diff(np.unique(disparity))
        bar_width = 0.8 * (gaps.min() if gaps.size else 1.0)
        for label, chosen, color in (("left out", ~kept, "#c3cfdb"), (f"top {k}", kept, "#2b5c8a")):
            if chosen.any():
                legend[label] = panel.bar(disparity[chosen], probability[chosen], bar_width, color=color)
        values = {name: float(values[y, x]) for name, values in known.items()}
        values.setdefault("estimate", float(np.average(disparity[kept], weights=probability[kept])))
        if 0 < values.get("truth", 0) < math.inf:
            legend["truth"] = panel.axvline(values["truth"], color="tab:green", linewidth=2.4)
        if math.isfinite(values["estimate"]):
            legend["estimate"] = panel.axvline(values["estimate"], color="tab:red", ls="--", linewidth=1.6)
        panel.set_title(f"x = {x}, y = {y}", fontsize="medium")
        panel.spines[["top", "right"]].set_visible(False)
    for panel in panels[len(pixels) :]:
        panel.set_axis_off()
    figure.supxlabel("disparity [px]", fontsize="medium")
    figure.supylabel("probability", fontsize="medium")
    figure.legend(legend.values(), legend.keys(), loc="outside upper center", ncols=4, frameon=False)
    return figure


def _softmax(scores: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    with np.errstate(invalid="ignore"):
        weight = np.exp(scores - scores.max())
        return np.asarray(weight / weight.sum())


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


def _color_table(name: str) -> Picture:
    """The 256 RGB colours of an OpenCV colour map, (256, 3)."""
    if name not in _COLORMAPS:
        raise ConfigError(f"unknown colormap {name!r}; {suggest(name, list(_COLORMAPS))}")
    levels = np.arange(256, dtype=np.uint8)[:, None]
    return np.ascontiguousarray(cv2.applyColorMap(levels, _COLORMAPS[name])[:, 0, ::-1])


def _checked_range(value_range: tuple[float, float]) -> tuple[float, float]:
    lo, hi = (float(v) for v in value_range)
    if not (math.isfinite(lo) and math.isfinite(hi) and lo < hi):
        raise InputError(f"value_range is ({lo:g}, {hi:g}); expected two finite numbers with lo < hi, such as (0, 192)")
    return lo, hi


def _as_map(values: Any, name: str) -> FloatMap:
    array = as_array(values)
    if array.ndim != 2 or 0 in array.shape or array.dtype.kind not in "fiub":
        raise InputError(
            f"{name} has shape {array.shape} and type {array.dtype}; expected one map of numbers, (H, W)"
            + (f": take {name}[0]" if array.ndim == 3 and array.shape[0] == 1 else "")
        )
    return array.astype(np.float32)


def _as_mask(values: Any, name: str, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    array = as_array(values)
    if array.dtype != bool or array.shape != shape:
        raise InputError(f"{name} is {array.dtype} of shape {array.shape}; expected bool, {shape}")
    return array
