"""Matching data sets and counting errors."""

import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import torch

from stereokit.data.datasets.dataset import StereoDataset, StereoEntry, StereoSample
from stereokit.data.datasets.opening import open_dataset
from stereokit.data.disparity_arrays import Disparity, doubts_of_prediction
from stereokit.data.inputs import as_array
from stereokit.errors import ConfigError, InputError, StereoKitError
from stereokit.evaluation.matcher import BatchMatcher, Matcher, describe_matcher
from stereokit.evaluation.results import DatasetResult, Evaluation, PairResult
from stereokit.metrics import PixelCounts, StereoMetrics, count_pixels
from stereokit.runtime.clock import synchronised_clock
from stereokit.runtime.provenance import machine, versions
from stereokit.tables import counted

__all__ = ["Observer", "evaluate"]

Observer: TypeAlias = Callable[[str, StereoSample, Disparity, PairResult], None]
"""Is told of each pair: the data set's name, the sample, the prediction and the pair's result."""

Progress: TypeAlias = Callable[[Sequence[StereoEntry], str], Iterable[StereoEntry]]


def evaluate(
    matcher: Matcher,
    datasets: Sequence[str] | Mapping[str, StereoDataset],
    *,
    limit: int | None = None,
    max_disparity: float | None = None,
    min_disparity: float = 0,
    taus: Sequence[float] = (1.0, 2.0, 3.0),
    batch: int = 1,
    warmup: int = 1,
    observers: Sequence[Observer] = (),
    progress: Progress = lambda entries, name: entries,
    command: str | None = None,
) -> Evaluation:
    """Matches every pair of some data sets and counts its errors.

    The time of a pair runs from images in memory to disparity in memory, after the device has finished what it was
    doing. Reading files and counting errors are not in it, nor is what the matcher names as its `preparation_seconds`,
    if it has this attribute: what was needed once, or once for a size of images, such as compiling.

    Args:
        matcher: any callable (left, right) -> disparity, see `Matcher`; `NetworkMatcher` for a network.
        datasets: "KIND:ROOT" each, as `open_dataset` takes it; or opened ones by any name.
        limit: only the first so many pairs of each data set.
        max_disparity: ceiling of the ground truth, exclusive, in pixels. None counts every known pixel.
        min_disparity: floor of the ground truth in pixels, see `stereokit.metrics.valid_pixels`; the matcher is told
            by itself (`Predictor`).
        taus: thresholds of bad-tau, in pixels.
        batch: how many pairs of equal size are matched at once. Above 1 it takes a `BatchMatcher`.
        warmup: how often the first pair of each data set is matched before the clock starts.
        observers: are told of each pair, in no fixed order where `batch` is above 1.
        progress: what the pairs pass through on the way, with the data set's name.
        command: the command line, for the record.

    Returns:
        The numbers, with all that is needed to repeat them. `docs/metrics.md` says how they are counted.

    Raises:
        InputError: a data set or a pair that can't be read, ground truth or a prediction of another size than the
            images, or a prediction that is no disparity map. Nothing is left out in silence.
        ConfigError: an option that can't be.

    >>> import tempfile
    >>> from pathlib import Path
    >>> from stereokit.data import write_disparity, write_image
    >>> root = Path(tempfile.mkdtemp())
    >>> for view in ("left", "right"):
    ...     write_image(root / f"{view}.png", np.zeros((4, 6, 3), np.uint8))
    >>> write_disparity(root / "disparity.pfm", np.full((4, 6), 5.0))
    >>> result = evaluate(lambda left, right: np.full(left.shape[:2], 7.0), [f"folder:{root}"])
    >>> result.datasets[0].metrics["epe"], result.datasets[0].metrics["bad_1"]
    (2.0, 100.0)
    """
    if not datasets:
        raise InputError("no data set was given; expected at least one, such as kitti2012:ROOT")
    for name, number, least in (("limit", limit, 1), ("batch", batch, 1), ("warmup", warmup, 0)):
        if number is not None and number < least:
            raise ConfigError(f"{name} is {number}; expected at least {least}")
    if batch > 1 and not isinstance(matcher, BatchMatcher):
        raise ConfigError(f"batch is {batch}, but this matcher takes one pair at a time; leave it at 1")
    if len(set(datasets)) < len(datasets):
        raise InputError(f"the data sets are {', '.join(datasets)}; expected each once")
    opened = datasets if isinstance(datasets, Mapping) else {spec: open_dataset(spec) for spec in datasets}
    rules = StereoMetrics(taus=taus, max_disparity=max_disparity, min_disparity=min_disparity)
    # first, since it may fail
    model = describe_matcher(matcher)
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    results = []
    for name, dataset in opened.items():
        chosen = dataset[:limit]
        pairs: dict[str, PairResult] = {}
        total = StereoMetrics(**rules.settings())
        truth, odd = PixelCounts(), list[str]()
        for samples in _batches(progress(chosen.entries, name), batch):
            if not pairs:
                for _ in range(warmup):
                    _match(matcher, samples)
            predictions, seconds = _match(matcher, samples)
            # negative ones were asked for
            odd += filter(None, map(doubts_of_prediction, predictions if min_disparity >= 0 else ()))
            predictions = [prediction.astype(np.float32) for prediction in predictions]
            for sample, prediction in zip(samples, predictions, strict=True):
                row = StereoMetrics(**rules.settings())
                pair = _pair_result(sample, prediction, seconds / len(samples), row)
                total.merge(row)
                if sample.disparity is not None:
                    truth += count_pixels(
                        sample.disparity, max_disparity=rules.max_disparity, min_disparity=rules.min_disparity
                    )
                pairs[sample.name] = pair
                for observer in observers:
                    observer(name, sample, prediction, pair)
        results.append(
            DatasetResult(
                name=name,
                kind=dataset.kind,
                root=str(dataset.root.absolute()),
                split=dataset.split,
                available=len(dataset),
                metrics=total.compute(),
                median_seconds=statistics.median(pair.seconds for pair in pairs.values()),
                truth_pixels=asdict(truth),
                doubt=f"{counted(len(odd), 'pair')}: {odd[0]}" if odd else None,
                pairs=tuple(pairs[entry.name] for entry in chosen.entries),
            )
        )
    return Evaluation(
        model=model,
        settings={
            **rules.settings(),
            "limit": limit,
            "batch": batch,
            "warmup": warmup,
        },
        masks=_mask_rules(rules),
        machine=machine(),
        versions=versions(),
        started=started,
        command=command,
        datasets=tuple(results),
    )


def _batches(entries: Iterable[StereoEntry], batch: int) -> Iterator[list[StereoSample]]:
    """Groups of up to `batch` samples of one size and type. Few are held at a time, however mixed the sizes are."""
    waiting: dict[Any, list[StereoSample]] = {}
    for entry in entries:
        sample = entry.read()
        key = (sample.left.shape, sample.left.dtype, sample.right.dtype)
        # the group that got a sample last is at the end
        group = waiting[key] = [*waiting.pop(key, []), sample]
        if len(group) == batch:
            yield waiting.pop(key)
        elif sum(map(len, waiting.values())) > 2 * batch:
            yield waiting.pop(next(iter(waiting)))
    yield from waiting.values()


def _match(matcher: Matcher, samples: Sequence[StereoSample]) -> tuple[list[npt.NDArray[Any]], float]:
    """The disparities of samples of one size, and the seconds for all of them."""
    start = synchronised_clock()
    try:
        if len(samples) > 1:
            assert isinstance(matcher, BatchMatcher)
            given = list(matcher.match_batch([s.left for s in samples], [s.right for s in samples]))
        else:
            given = [matcher(samples[0].left, samples[0].right)]
    except StereoKitError as error:
        raise InputError(f"pair {samples[0].name!r}: {error}") from error
    except Exception as error:
        # a matcher is anybody's function
        raise InputError(
            f"pair {samples[0].name!r}: the matcher failed with {type(error).__name__}: {error}"
        ) from error
    # A tensor on a device counts when it has arrived in memory.
    arrays = [as_array(prediction) for prediction in given]
    seconds = synchronised_clock() - start - getattr(matcher, "preparation_seconds", 0.0)
    if len(arrays) != len(samples):
        raise InputError(f"the matcher gave {len(arrays)} maps for {len(samples)} pairs; expected one for each")
    return [_checked(array, sample) for array, sample in zip(arrays, samples, strict=True)], seconds


def _checked(prediction: npt.NDArray[Any], sample: StereoSample) -> npt.NDArray[Any]:
    height, width = sample.left.shape[:2]
    if prediction.dtype.kind not in "fiu":
        raise InputError(f"pair {sample.name!r}: the matcher gave {prediction.dtype}; expected disparity in pixels")
    if prediction.shape != (height, width):
        raise InputError(
            f"pair {sample.name!r}: the matcher gave a map of shape {prediction.shape}; "
            f"expected that of the images, {(height, width)}"
        )
    return prediction


def _pair_result(sample: StereoSample, prediction: Disparity, seconds: float, row: StereoMetrics) -> PairResult:
    metrics = None
    if sample.disparity is not None:
        row.update(
            torch.from_numpy(prediction)[None],
            torch.from_numpy(sample.disparity)[None],
            nonoccluded=None if sample.nonocc is None else torch.from_numpy(sample.nonocc)[None],
            foreground=None if sample.objects is None else torch.from_numpy(sample.objects > 0)[None],
        )
        metrics = row.compute()
    height, width = prediction.shape
    invalid = int(np.count_nonzero(~np.isfinite(prediction)))
    return PairResult(sample.name, width, height, seconds, invalid, metrics)


def _mask_rules(rules: StereoMetrics) -> dict[str, str]:
    floor = f"at least {rules.min_disparity:g} px" if rules.min_disparity else "above 0"
    ceiling = "" if rules.max_disparity is None else f" and below {rules.max_disparity:g} px"
    return {
        "counted": f"pixels whose ground truth is finite and {floor}{ceiling}; sparse truth is never interpolated",
        "noc": "counted pixels where the data set's non-occlusion mask is set",
        "occ": "counted pixels where it is not",
        "fg": "counted pixels whose object map is above 0",
        "bg": "counted pixels whose object map is 0",
        "prediction not finite": "bad at every tau, a D1 outlier, not in EPE; counted as invalid_predictions",
        "per_image": "mean over images of each image's mean; without this suffix over all pixels of all images pooled",
    }
