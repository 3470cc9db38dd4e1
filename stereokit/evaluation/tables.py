"""The numbers of an evaluation as rows of text."""

from collections.abc import Sequence

from stereokit.errors import printable
from stereokit.evaluation.results import DatasetResult, PairResult
from stereokit.metrics import KITTI_METRICS, PixelCounts
from stereokit.tables import Table, counted, share

__all__ = ["benchmark_line", "dataset_table", "format_dataset", "notes", "pair_table"]

REGION_NAMES = {
    "": "all",
    "_noc": "non-occluded",
    "_occ": "occluded",
    "_bg": "background",
    "_fg": "foreground",
}
NOTHING = "no pixels"


def dataset_table(result: DatasetResult, taus: Sequence[float]) -> Table:
    """A row per region and mean."""
    metrics = result.metrics
    rows = []
    for suffix, region in REGION_NAMES.items():
        if f"pixels{suffix}" not in metrics:
            continue
        for mean, unit in (("", "pixel"), ("_per_image", "image")):
            cells = [_number(metrics[f"{measure}{suffix}{mean}"]) for measure in _measures(taus)]
            rows.append((f"{region}, per {unit}", *cells, counted(int(metrics[f"{unit}s{suffix}"] or 0), unit)))
    return Table(("pixels, mean", *_headings(taus), "over"), tuple(rows))


def pair_table(pairs: Sequence[PairResult], taus: Sequence[float]) -> Table:
    """A row per pair, in the given order, over all counted pixels."""
    measures = _measures(taus)
    rows = tuple(
        (
            printable(pair.name, quoted=False),
            f"{pair.width} x {pair.height}",
            *(_number(pair.metrics[name]) if pair.metrics else "" for name in measures),
            f"{pair.metrics['pixels']:,}" if pair.metrics else "no ground truth",
            f"{pair.invalid_pixels:,}",
            f"{pair.seconds:.3f}",
        )
        for pair in pairs
    )
    return Table(("pair", "size", *_headings(taus), "counted pixels", "not finite", "seconds"), rows)


def notes(result: DatasetResult) -> list[str]:
    """What the table does not show: the benchmark's own numbers, and what was not predicted or not known."""
    metrics = result.metrics
    lines = [benchmark_line(result)] if benchmark_line(result) else []
    invalid, pixels = metrics["invalid_predictions"] or 0, metrics["pixels"] or 0
    everywhere = sum(pair.invalid_pixels for pair in result.pairs)
    if everywhere:
        lines.append(
            f"{everywhere:,} predicted pixels are not finite; of the {pixels:,} counted ones {invalid:,}"
            f"{f' ({share(invalid, pixels)})' if pixels else ''}: bad at every threshold, and not in EPE"
        )
    counts = PixelCounts(**result.truth_pixels)
    if dropped := counts.dropped():
        rules = ", ".join(f"{share(number, counts.known)} {rule}" for rule, number in dropped.items())
        lines.append(f"of the ground truth's {counts.known:,} values {counts.valid:,} count: {rules} do not")
    if result.doubt:
        lines.append(f"predictions of {result.doubt}")
    without = sum(pair.metrics is None for pair in result.pairs)
    if without:
        lines.append(f"{without} of {len(result.pairs)} pairs have no ground truth")
    if metrics["images_without_pixels"]:
        without_pixels = counted(int(metrics["images_without_pixels"]), "pair")
        lines.append(f"{without_pixels} with ground truth, but without a pixel that counts")
    if len(result.pairs) < result.available:
        lines.append(f"only the first {len(result.pairs)} of {result.available} pairs")
    return lines


def benchmark_line(result: DatasetResult) -> str:
    """The numbers by their names on KITTI's leaderboards, for its data sets; else nothing."""
    names = {"kitti2012": ("Out-Noc", "Out-All", "Avg-Noc", "Avg-All"), "kitti2015": ("D1-bg", "D1-fg", "D1-all")}
    found = [(name, result.metrics.get(KITTI_METRICS[name])) for name in names.get(result.kind, ())]
    units = {True: " px", False: " %"}
    return ", ".join(f"{name} {value:.2f}{units[name.startswith('Avg')]}" for name, value in found if value is not None)


def format_dataset(result: DatasetResult, taus: Sequence[float]) -> str:
    """A data set's heading, table and notes, as lines of text."""
    name, pairs = printable(result.name, quoted=False), counted(len(result.pairs), "pair")
    heading = f"{name}: split {result.split}, {pairs}, median {result.median_seconds:.3f} s per pair"
    table = str(dataset_table(result, taus))
    return "\n".join([heading, *(f"  {line}" for line in [*table.splitlines(), *notes(result)])])


def _measures(taus: Sequence[float]) -> list[str]:
    return ["epe", *(f"bad_{tau:g}" for tau in taus), "d1"]


def _headings(taus: Sequence[float]) -> list[str]:
    return ["EPE [px]", *(f"bad-{tau:g} [%]" for tau in taus), "D1 [%]"]


def _number(value: float | None) -> str:
    return NOTHING if value is None else f"{value:.2f}"
