"""The distributions behind an estimate."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from stereokit.data.inputs import as_array
from stereokit.errors import ConfigError, InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure
from stereokit.pictures.colors import as_map

__all__ = ["distribution_figure"]


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
    known = {name: as_map(values, name) for name, values in maps.items() if values is not None}
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
