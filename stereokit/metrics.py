"""Errors of a disparity map against ground truth, counted as the benchmarks count them.

A pixel counts where its truth d* is known, which is finite and 0 < d* (< `max_disparity`, where a ceiling is
given), and where the caller's mask holds. A prediction d that is not finite is an error of infinite size: bad
at every threshold. It has no end-point error, so the mean end-point error leaves it out, and
`invalid_predictions` says how many there are. Shares are in percent. A mean over no pixels is None.
`docs/metrics.md` has all rules in one table.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.distributed
from torch import Tensor

from stereokit.errors import InputError

__all__ = [
    "KITTI_METRICS",
    "StereoMetrics",
    "bad_pixels",
    "d1",
    "end_point_error",
    "invalid_predictions",
    "valid_pixels",
]

KITTI_METRICS = {
    "D1-all": "d1",
    "D1-bg": "d1_bg",
    "D1-fg": "d1_fg",
    "Out-All": "bad_3_per_image",
    "Out-Noc": "bad_3_noc_per_image",
    "Avg-All": "epe_per_image",
    "Avg-Noc": "epe_noc_per_image",
}
"""The KITTI leaderboards' names for results of `StereoMetrics`: D1 is of KITTI 2015, Out and Avg of 2012."""

D1_ABSOLUTE, D1_RELATIVE = 3.0, 0.05
REGIONS = ("all", "noc", "occ", "bg", "fg")


def valid_pixels(truth: Tensor, mask: Tensor | None = None, *, max_disparity: float | None = None) -> Tensor:
    """Where ground truth counts: 0 < d* < max_disparity, finite, and within the mask.

    Args:
        truth: d*, any shape, in pixels.
        mask: bool, of the truth's shape; pixels to leave out are False.
        max_disparity: ceiling, exclusive, in pixels. None counts every known pixel.

    Returns:
        bool, of the truth's shape.

    Raises:
        InputError: a mask of another shape or type, or a ceiling that leaves nothing.

    >>> truth = torch.tensor([0.0, 5.0, 200.0, float("nan"), float("inf")])
    >>> valid_pixels(truth, max_disparity=192).tolist()
    [False, True, False, False, False]
    """
    valid = torch.isfinite(truth) & (truth > 0)
    if max_disparity is not None:
        valid &= truth < _checked_ceiling(max_disparity)
    if mask is not None:
        valid &= _checked_mask(mask, "mask", truth)
    return valid


def end_point_error(
    prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, max_disparity: float | None = None
) -> float | None:
    """The mean end-point error (EPE) over all counted pixels that have a finite prediction, in pixels.

    EPE = mean |d - d*|. Report `invalid_predictions` beside it where there are any.

    Args:
        prediction: d, any shape, in pixels.
        truth: d*, of the prediction's shape; 0 or non-finite is unknown.
        mask: bool, of the same shape; pixels to leave out are False.
        max_disparity: ceiling of the truth, exclusive, in pixels.

    Returns:
        The error in pixels, or None where there is no pixel to average.

    Raises:
        InputError: tensors of different shapes or of the wrong type.

    >>> end_point_error(torch.tensor([10.0, 21.0, 30.0]), torch.tensor([12.0, 20.0, 0.0]))
    1.5
    >>> end_point_error(torch.tensor([10.0]), torch.tensor([0.0])) is None
    True
    """
    error, _, valid = _absolute_error(prediction, truth, mask, max_disparity)
    return _mean(error[valid & torch.isfinite(error)])


def bad_pixels(
    prediction: Tensor,
    truth: Tensor,
    tau: float,
    mask: Tensor | None = None,
    *,
    max_disparity: float | None = None,
) -> float | None:
    """Bad-tau: the share of counted pixels whose error is larger than tau pixels, in percent.

    bad-tau = 100 |{|d - d*| > tau}| / |{counted}|

    KITTI 2012 calls it Out for tau = 3, Middlebury "bad 2.0" for tau = 2. A non-finite prediction is bad.

    Args:
        prediction: d, any shape, in pixels.
        truth: d*, of the prediction's shape; 0 or non-finite is unknown.
        tau: threshold in pixels; an error of exactly tau is not bad.
        mask: bool, of the same shape; pixels to leave out are False.
        max_disparity: ceiling of the truth, exclusive, in pixels.

    Returns:
        0 to 100, or None where no pixel counts.

    Raises:
        InputError: tensors of different shapes or of the wrong type, or a tau that is negative or not finite.

    Source: KITTI 2012 stereo devkit, `disparityErrorsOutlier`; Middlebury stereo evaluation v3, "bad".

    >>> bad_pixels(torch.tensor([10.0, 25.0]), torch.tensor([13.0, 20.0]), tau=3)
    50.0
    """
    error, _, valid = _absolute_error(prediction, truth, mask, max_disparity)
    return _percent((error > _checked_tau(tau))[valid])


def d1(
    prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, max_disparity: float | None = None
) -> float | None:
    """D1: the share of counted pixels that are outliers in KITTI 2015's sense, in percent.

    D1 = 100 |{|d - d*| > 3 px and |d - d*| / d* > 5 %}| / |{counted}|

    A non-finite prediction is an outlier. D1-bg and D1-fg are this over the mask of the background (object
    map 0) and of the foreground (object map above 0).

    Args:
        prediction: d, any shape, in pixels.
        truth: d*, of the prediction's shape; 0 or non-finite is unknown.
        mask: bool, of the same shape; pixels to leave out are False.
        max_disparity: ceiling of the truth, exclusive, in pixels. KITTI has none.

    Returns:
        0 to 100, or None where no pixel counts.

    Raises:
        InputError: tensors of different shapes or of the wrong type.

    Source: KITTI 2015 scene flow devkit, `disparityErrorsOutlier` (Menze and Geiger, CVPR 2015).

    >>> d1(torch.tensor([14.0, 104.0, 106.0]), torch.tensor([10.0, 100.0, 0.0]))
    50.0
    """
    error, truth, valid = _absolute_error(prediction, truth, mask, max_disparity)
    return _percent(_is_outlier(error, truth)[valid])


def invalid_predictions(
    prediction: Tensor, truth: Tensor, mask: Tensor | None = None, *, max_disparity: float | None = None
) -> int:
    """How many counted pixels have a prediction that is not finite.

    Args:
        prediction: d, any shape, in pixels.
        truth: d*, of the prediction's shape; 0 or non-finite is unknown.
        mask: bool, of the same shape; pixels to leave out are False.
        max_disparity: ceiling of the truth, exclusive, in pixels.

    Raises:
        InputError: tensors of different shapes or of the wrong type.

    >>> invalid_predictions(torch.tensor([math.nan, math.inf, math.nan]), torch.tensor([5.0, 5.0, 0.0]))
    2
    """
    error, _, _ = _absolute_error(prediction, truth, mask, max_disparity)
    return int(torch.isinf(error).sum())


class StereoMetrics:
    """EPE, bad-tau and D1 over a data set, image by image, without keeping the images.

    Each measure exists twice: the mean over all pixels pooled (`epe`), in which an image with more ground
    truth weighs more, and the mean over images of each image's own mean (`epe_per_image`). Sums are float64
    and counts int64, on the CPU, whatever device the images are on.

    Args:
        taus: thresholds of bad-tau, in pixels.
        max_disparity: ceiling of the truth, exclusive, in pixels. None counts every known pixel, as KITTI
            does; 192 is customary for SceneFlow.

    Raises:
        InputError: a threshold that is negative, not finite or given twice, or a ceiling that leaves nothing.

    >>> metrics = StereoMetrics(taus=(1, 3), max_disparity=192)
    >>> truth = torch.tensor([[[10.0, 20.0, 0.0]], [[50.0, 300.0, 0.0]]])
    >>> metrics.update(truth + torch.tensor([[[2.0]], [[4.0]]]), truth)
    >>> results = metrics.compute()
    >>> {name: results[name] for name in ("bad_3", "bad_3_per_image", "epe_per_image", "pixels", "images")}
    {'bad_3': 33.333333333333336, 'bad_3_per_image': 50.0, 'epe_per_image': 3.0, 'pixels': 3, 'images': 2}

    An accumulator of one image gives that image's row, and merges into the data set's:

    >>> row = StereoMetrics(taus=(1, 3), max_disparity=192)
    >>> row.update(truth[:1], truth[:1])
    >>> row.compute()["epe"], metrics.merge(row).compute()["images"]
    (0.0, 3)
    """

    def __init__(self, *, taus: Sequence[float] = (1.0, 2.0, 3.0), max_disparity: float | None = None) -> None:
        self.taus = tuple(_checked_tau(tau) for tau in taus)
        self.max_disparity = None if max_disparity is None else _checked_ceiling(max_disparity)
        self._measures = ("epe", *(f"bad_{tau:g}" for tau in self.taus), "d1")
        if len(set(self._measures)) < len(self._measures):
            raise InputError(f"taus are {self.taus}; expected thresholds that differ")
        shape = (len(REGIONS), len(self._measures))
        # Row: region. Column: measure. Pooled over pixels, then over images; `_seen` also counts images in
        # which no pixel of the region counts.
        self._sums = torch.zeros(shape, dtype=torch.float64)
        self._pixels = torch.zeros(shape, dtype=torch.int64)
        self._image_sums = torch.zeros(shape, dtype=torch.float64)
        self._images = torch.zeros(shape, dtype=torch.int64)
        self._seen = torch.zeros(len(REGIONS), dtype=torch.int64)

    @torch.no_grad()
    def update(
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
        nonoccluded: Tensor | None = None,
        foreground: Tensor | None = None,
    ) -> None:
        """Adds a batch of images.

        Args:
            prediction: (B, H, W), in pixels, on any device.
            truth: (B, H, W), in pixels; 0 or non-finite is unknown.
            nonoccluded: (B, H, W), bool: pixels that the right image sees too. Makes `noc` and `occ` known.
                For KITTI, where `disp_noc` has a value.
            foreground: (B, H, W), bool: pixels of objects. Makes `bg` and `fg` known. For KITTI 2015, where
                the object map is above 0.

        Raises:
            InputError: tensors of another shape or type.
        """
        error, truth, valid = _absolute_error(prediction, truth, None, self.max_disparity)
        if error.ndim != 3:
            raise InputError(f"prediction has shape {tuple(error.shape)}; expected a batch of maps, (B, H, W)")
        finite = torch.isfinite(error)
        bad = [error > tau for tau in self.taus] + [_is_outlier(error, truth)]
        error = error.masked_fill(~finite, 0)

        regions = {"all": valid}
        if nonoccluded is not None:
            mask = _checked_mask(nonoccluded, "nonoccluded", truth)
            regions |= {"noc": valid & mask, "occ": valid & ~mask}
        if foreground is not None:
            mask = _checked_mask(foreground, "foreground", truth)
            regions |= {"bg": valid & ~mask, "fg": valid & mask}

        for name, region in regions.items():
            row = REGIONS.index(name)
            # (B, measures) each: of every image the sums and how many pixels they are over.
            error_sum = (error * region).sum((1, 2)).cpu().double()
            flags = torch.stack([region & finite, region, *(region & b for b in bad)], 1)
            counts = flags.sum((2, 3)).cpu()
            sums = torch.cat([error_sum[:, None], counts[:, 2:].double()], 1)
            pixels = torch.cat([counts[:, :1], counts[:, 1:2].expand(-1, len(bad))], 1)
            self._sums[row] += sums.sum(0)
            self._pixels[row] += pixels.sum(0)
            self._image_sums[row] += (sums / pixels.clamp(min=1)).sum(0)
            self._images[row] += (pixels > 0).sum(0)
            self._seen[row] += len(prediction)

    def compute(self) -> dict[str, float | int | None]:
        """All results so far, by name.

        Names are `<measure><region><mean>`:

        - measure: `epe` in pixels; `bad_<tau>` and `d1` in percent;
        - region: none for all counted pixels; `_noc` and `_occ`, non-occluded and occluded; `_bg` and `_fg`,
          background and foreground. Regions are absent where no update told them apart;
        - mean: none for the mean over pooled pixels; `_per_image` for the mean over images, of those images
          that have a pixel to average.

        Beside them, for each region: `pixels` that count; `images` with at least one of them;
        `images_without_pixels`; and `invalid_predictions`, how many of the pixels have a prediction that is
        not finite. These are in bad-tau and D1 as errors, and not in EPE. A mean over nothing is None.
        """
        results: dict[str, float | int | None] = {}
        for row, region in enumerate(REGIONS):
            if region != "all" and not self._seen[row]:
                continue
            suffix = "" if region == "all" else f"_{region}"
            for column, measure in enumerate(self._measures):
                unit = 1.0 if measure == "epe" else 100.0
                for mean, sums, numbers in (
                    ("", self._sums, self._pixels),
                    ("_per_image", self._image_sums, self._images),
                ):
                    number = int(numbers[row, column])
                    value = unit * float(sums[row, column]) / number if number else None
                    results[f"{measure}{suffix}{mean}"] = value
            pixels, images = int(self._pixels[row, -1]), int(self._images[row, -1])
            results[f"pixels{suffix}"] = pixels
            results[f"images{suffix}"] = images
            results[f"images_without_pixels{suffix}"] = int(self._seen[row]) - images
            results[f"invalid_predictions{suffix}"] = pixels - int(self._pixels[row, 0])
        return results

    def merge(self, other: "StereoMetrics") -> "StereoMetrics":
        """Adds what another accumulator has seen, as if its images had been given to this one.

        Returns:
            This accumulator.

        Raises:
            InputError: the other one counts by other rules.
        """
        for name in ("taus", "max_disparity"):
            mine, theirs = getattr(self, name), getattr(other, name)
            if mine != theirs:
                raise InputError(f"metrics with {name}={mine} and {name}={theirs} can't be merged; use one for both")
        for name, tensor in self._tensors().items():
            tensor += other._tensors()[name]
        return self

    def merged_over_processes(self, group: Any = None) -> "StereoMetrics":
        """The sum over all processes of a `torch.distributed` group; alone, a copy.

        Every process has to call it, and each gets the same. A sampler that repeats images so that the
        processes have equally many makes them count twice.

        Args:
            group: a process group, or None for all processes.
        """
        states = [self.state_dict()]
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            states = states * torch.distributed.get_world_size(group)
            torch.distributed.all_gather_object(states, self.state_dict(), group=group)
        merged = StereoMetrics(taus=self.taus, max_disparity=self.max_disparity)
        for state in states:
            merged.merge(StereoMetrics.from_state_dict(state))
        return merged

    def state_dict(self) -> dict[str, Any]:
        """Everything seen so far, in numbers and lists that JSON keeps exactly.

        >>> metrics = StereoMetrics(taus=[2])
        >>> StereoMetrics.from_state_dict(metrics.state_dict()).compute() == metrics.compute()
        True
        """
        settings = {"taus": list(self.taus), "max_disparity": self.max_disparity}
        return {**settings, **{name: tensor.tolist() for name, tensor in self._tensors().items()}}

    @classmethod
    def from_state_dict(cls, state: Mapping[str, Any]) -> "StereoMetrics":
        """The accumulator that `state_dict` described.

        Raises:
            InputError: names missing, unknown or of another size.
        """
        expected = list(cls().state_dict())
        if set(state) != set(expected):
            raise InputError(
                f"the metrics' state has the entries {', '.join(map(str, state)) or 'none'}; "
                f"expected {', '.join(expected)}"
            )
        try:
            metrics = cls(taus=state["taus"], max_disparity=state["max_disparity"])
            for name, tensor in metrics._tensors().items():
                values = torch.tensor(state[name], dtype=tensor.dtype)
                if values.shape != tensor.shape:
                    raise InputError(f"{name} has shape {tuple(values.shape)}; expected {tuple(tensor.shape)}")
                tensor.copy_(values)
        except (TypeError, ValueError, OverflowError, RuntimeError) as error:
            raise InputError(f"the metrics' state is damaged: {error}") from error
        return metrics

    def _tensors(self) -> dict[str, Tensor]:
        return {
            "sums": self._sums,
            "pixels": self._pixels,
            "image_sums": self._image_sums,
            "images": self._images,
            "seen": self._seen,
        }


def _absolute_error(
    prediction: Tensor, truth: Tensor, mask: Tensor | None, max_disparity: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    """|d - d*|, infinite without a prediction; d* in the same type; which pixels count. On one device."""
    for name, tensor in (("prediction", prediction), ("truth", truth)):
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise InputError(f"{name} is {kind}; expected disparity in pixels, a floating-point torch.Tensor")
    if prediction.shape != truth.shape:
        raise InputError(
            f"prediction has shape {tuple(prediction.shape)} and truth {tuple(truth.shape)}; expected the same for both"
        )
    # In float64 the difference of two float32 numbers is exact, so that an error of exactly 3 px is not
    # "above 3". Apple's GPUs have no float64.
    dtype = torch.float32 if prediction.device.type == "mps" else torch.float64
    truth = truth.detach().to(prediction.device)
    valid = valid_pixels(truth, mask, max_disparity=max_disparity)
    prediction, truth = prediction.detach().to(dtype), truth.to(dtype)
    error = (prediction - truth).abs().masked_fill(~torch.isfinite(prediction), math.inf)
    return error.masked_fill(~valid, 0), truth, valid


def _is_outlier(error: Tensor, truth: Tensor) -> Tensor:
    """KITTI 2015's outlier: more than 3 px and more than 5 % of the truth."""
    return (error > D1_ABSOLUTE) & (error / truth > D1_RELATIVE)


def _mean(values: Tensor) -> float | None:
    return float(values.mean()) if values.numel() else None


def _percent(flags: Tensor) -> float | None:
    return 100.0 * int(flags.sum()) / flags.numel() if flags.numel() else None


def _checked_mask(mask: Tensor, name: str, truth: Tensor) -> Tensor:
    if mask.dtype != torch.bool or mask.shape != truth.shape:
        raise InputError(
            f"{name} is {mask.dtype} of shape {tuple(mask.shape)}; expected torch.bool of the truth's shape, "
            f"{tuple(truth.shape)}"
        )
    return mask.to(truth.device)


def _checked_tau(tau: float) -> float:
    if not 0 <= tau < math.inf:
        raise InputError(f"tau is {tau}; expected a threshold in pixels, 0 or larger")
    return float(tau)


def _checked_ceiling(max_disparity: float) -> float:
    if not 0 < max_disparity < math.inf:
        raise InputError(f"max_disparity is {max_disparity}; expected pixels above 0, or None for no ceiling")
    return float(max_disparity)
