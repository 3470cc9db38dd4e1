"""Reading a whole data set once, to know what is in it before trusting numbers from it."""

import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from stereokit.data.datasets.dataset import StereoDataset, StereoEntry, StereoSample
from stereokit.data.disparity_arrays import doubts
from stereokit.errors import InputError, printable
from stereokit.metrics import count_pixels
from stereokit.tables import counted, share

__all__ = ["DatasetReport", "check_dataset", "format_report"]


@dataclass
class DatasetReport:
    """What `check_dataset` found.

    Attributes:
        name: kind, split and place.
        pairs: number of pairs, broken ones too.
        sizes: how many pairs there are of each (width, height).
        with_truth: number of pairs with ground truth; likewise `with_nonocc`, `with_objects`,
            `with_calibration`.
        known_pixels: number of pixels whose disparity counts by `stereokit.metrics.valid_pixels`.
        dropped: number of pixels that have a value and do not count, by the rule that leaves them out.
        truth_pixels: number of pixels of the pairs with ground truth. `density` is the ratio of the two.
        lowest: the smallest finite disparity in pixels, None where there is none.
        highest: the largest.
        sparsest: name and density of the pair with the least known disparity.
        assumed_scales: how many pairs have ground truth whose scale was assumed, for each such scale.
        warnings: what was odd, and in how many pairs.
        broken: name and error of each pair that can't be read.
        passed_over: folders of images that make no pair of the kind.
        unused_truth: files that look like ground truth and are not read.
    """

    name: str
    pairs: int = 0
    sizes: Counter[tuple[int, int]] = field(default_factory=Counter)
    with_truth: int = 0
    with_nonocc: int = 0
    with_objects: int = 0
    with_calibration: int = 0
    known_pixels: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    truth_pixels: int = 0
    lowest: float | None = None
    highest: float | None = None
    sparsest: tuple[str, float] | None = None
    assumed_scales: Counter[float] = field(default_factory=Counter)
    warnings: Counter[str] = field(default_factory=Counter)
    broken: list[tuple[str, str]] = field(default_factory=list)
    passed_over: tuple[str, ...] = ()
    unused_truth: tuple[str, ...] = ()

    @property
    def density(self) -> float | None:
        """The part of the pixels whose disparity is known, or None without ground truth."""
        return self.known_pixels / self.truth_pixels if self.truth_pixels else None

    def add(self, sample: StereoSample) -> None:
        """Counts one pair that could be read."""
        height, width = sample.left.shape[:2]
        self.sizes[width, height] += 1
        self.with_nonocc += sample.nonocc is not None
        self.with_objects += sample.objects is not None
        self.with_calibration += sample.calibration is not None
        if sample.disparity is None:
            return
        if sample.assumed_scale is not None:
            self.assumed_scales[sample.assumed_scale] += 1
        if doubt := doubts(sample.disparity):
            self.warnings[f"ground truth: {doubt}"] += 1
        known = sample.disparity[np.isfinite(sample.disparity)]
        counts = count_pixels(sample.disparity)
        density = counts.valid / sample.disparity.size
        self.with_truth += 1
        self.known_pixels += counts.valid
        self.dropped.update(counts.dropped())
        self.truth_pixels += sample.disparity.size
        if self.sparsest is None or density < self.sparsest[1]:
            self.sparsest = (sample.name, density)
        if known.size:
            lowest, highest = float(known.min()), float(known.max())
            self.lowest = lowest if self.lowest is None else min(self.lowest, lowest)
            self.highest = highest if self.highest is None else max(self.highest, highest)


def check_dataset(
    dataset: StereoDataset,
    *,
    progress: Callable[[Iterable[StereoEntry]], Iterable[StereoEntry]] = iter,
) -> DatasetReport:
    """Reads every file of a data set once.

    Args:
        dataset: opened with `allow_missing=True`, so that missing files are reported with the broken ones.
        progress: what to pass the pairs through on the way, such as `tqdm.tqdm`.

    >>> import pathlib, tempfile
    >>> from stereokit.data import write_image
    >>> from stereokit.data.datasets import open_dataset
    >>> root = pathlib.Path(tempfile.mkdtemp())
    >>> write_image(root / "left.png", np.zeros((4, 6, 3), np.uint8))
    >>> report = check_dataset(open_dataset(f"folder:{root}", allow_missing=True))
    >>> report.pairs, len(report.broken)
    (1, 1)
    """
    name = f"{dataset.kind}, split {dataset.split!r}, in {printable(dataset.root)}"
    report = DatasetReport(name, passed_over=dataset.passed_over, unused_truth=dataset.unused_truth)
    for entry in progress(dataset.entries):
        report.pairs += 1
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                report.add(entry.read())
            except InputError as error:
                report.broken.append((entry.name, str(error)))
        report.warnings.update({str(warning.message) for warning in caught})
    return report


def format_report(report: DatasetReport, *, most: int = 20) -> str:
    """The report as lines of text.

    Args:
        report: of `check_dataset`.
        most: how many sizes and how many broken pairs to list at most.
    """
    sizes = [f"{width} x {height} ({count})" for (width, height), count in report.sizes.most_common()]
    lines = [
        report.name,
        f"  pairs             {report.pairs}",
        f"  sizes             {_shortened(sizes, most)}",
        f"  ground truth      {report.with_truth}",
        f"  non-occ. masks    {report.with_nonocc}",
        f"  object maps       {report.with_objects}",
        f"  calibrations      {report.with_calibration}",
    ]
    if report.lowest is not None and report.highest is not None:
        lines.append(f"  disparity         {report.lowest:.2f} to {report.highest:.2f} pixels")
    if report.density is not None and report.sparsest is not None:
        name, density = printable(report.sparsest[0], quoted=False), report.sparsest[1]
        lines.append(f"  known disparity   {report.density:.1%} of the pixels; least in {name} ({density:.1%})")
    for rule, pixels in report.dropped.items():
        part = share(pixels, report.known_pixels + report.dropped.total())
        lines.append(f"  does not count    {part} of the pixels that have a value: {rule}")
    for scale, count in report.assumed_scales.most_common():
        lines.append(f"  scale assumed     {scale:g} for a pixel of disparity, in {counted(count, 'pair')}")
    lines += [
        f"  warning           {text} ({counted(count, 'pair')})" for text, count in report.warnings.most_common(most)
    ]
    lines.append(f"  broken            {len(report.broken)}")
    lines += [f"    {printable(name, quoted=False)}: {message}" for name, message in report.broken[:most]]
    if len(report.broken) > most:
        lines.append(f"    and {len(report.broken) - most} more")
    if report.passed_over:
        names = _shortened([printable(name, quoted=False) for name in report.passed_over], most)
        lines.append(f"  passed over       {names}: no files of the kind")
    if report.unused_truth:
        names = _shortened([printable(name, quoted=False) for name in report.unused_truth], most)
        lines.append(f"  not read          {names}: looks like ground truth, but is not named as the kind's")
    return "\n".join(lines)


def _shortened(items: list[str], most: int) -> str:
    more = f" and {len(items) - most} more" if len(items) > most else ""
    return ", ".join(items[:most]) + more if items else "none"
