"""What an evaluation found, and its files."""

import csv
import io
import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from stereokit.data.datasets.dataset import StereoSample
from stereokit.data.disparity_arrays import Disparity
from stereokit.errors import InputError, printable
from stereokit.files import atomic_path, check_free, make_folder

__all__ = ["DatasetResult", "Evaluation", "Metrics", "PairLog", "PairResult", "result_paths"]

Metrics: TypeAlias = dict[str, float | int | None]
"""Results by the names of `StereoMetrics.compute`."""


@dataclass(frozen=True)
class PairResult:
    """One pair.

    Attributes:
        name: of the pair, unique in its data set.
        width, height: of its images, in pixels.
        seconds: from images in memory to disparity in memory; for a batch, its time divided by the number of its pairs.
        invalid_pixels: how many pixels of the whole image have no finite prediction, with or without ground truth.
        metrics: of this pair, by the names of `StereoMetrics.compute`. None without ground truth.
    """

    name: str
    width: int
    height: int
    seconds: float
    invalid_pixels: int
    metrics: Metrics | None


@dataclass(frozen=True)
class DatasetResult:
    """One data set.

    Attributes:
        name: the data set as it was asked for, such as "kitti2012:/data/kitti2012".
        kind, root, split: of the data set; `root` is absolute.
        available: how many pairs it has; `pairs` are the first ones of them.
        metrics: over all pairs with ground truth.
        truth_pixels: of the ground truth, by the rule of `stereokit.metrics.count_pixels` that each falls under.
        doubt: what is odd about the predictions, most likely another unit or sign than pixels; None where nothing is.
        median_seconds: the median time per pair.
        pairs: in the order of the data set.
    """

    name: str
    kind: str
    root: str
    split: str
    available: int
    metrics: Metrics
    median_seconds: float
    pairs: tuple[PairResult, ...]
    truth_pixels: dict[str, int] = field(default_factory=dict)
    doubt: str | None = None


@dataclass(frozen=True)
class Evaluation:
    """The numbers, and all that is needed to repeat them.

    Attributes:
        model: what was evaluated, see `describe_matcher`.
        settings: the thresholds, the ceiling, the limit, the batch size and the untimed runs.
        masks: the rules by which pixels count, in words.
        machine: see `stereokit.runtime.provenance.machine`.
        versions: of Python and the libraries.
        started: time in UTC, ISO 8601.
        command: the command line, if there was one.
        datasets: the results.
    """

    model: dict[str, Any]
    settings: dict[str, Any]
    masks: dict[str, str]
    machine: dict[str, Any]
    versions: dict[str, str]
    started: str
    command: str | None
    datasets: tuple[DatasetResult, ...]

    def to_json(self) -> str:
        """Everything, as strict JSON."""
        return json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"

    def record(self) -> dict[str, Any]:
        """All but the numbers."""
        parts = asdict(self)
        parts["datasets"] = [
            {"name": d.name, "kind": d.kind, "root": d.root, "split": d.split, "pairs": len(d.pairs)}
            for d in self.datasets
        ]
        return parts

    def save(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> list[Path]:
        """Writes the files of `result_paths`, each whole or not at all.

        Args:
            folder: is made if need be.
            overwrite: replace existing files.

        Raises:
            InputError: a file exists already; then none is written.
        """
        paths = result_paths(folder)
        check_free(paths, overwrite=overwrite)
        make_folder(folder)
        per_dataset = [
            {"dataset": d.name, "pairs": len(d.pairs), "median_seconds": d.median_seconds, **d.metrics}
            for d in self.datasets
        ]
        per_pair = [
            {
                "dataset": d.name,
                "pair": p.name,
                "width": p.width,
                "height": p.height,
                "seconds": p.seconds,
                "invalid_pixels": p.invalid_pixels,
                **_of_one_image(p.metrics or {}),
            }
            for d in self.datasets
            for p in d.pairs
        ]
        for path, text in zip(paths, (self.to_json(), _csv(per_dataset), _csv(per_pair)), strict=True):
            with atomic_path(path, overwrite=overwrite) as temporary:
                temporary.write_text(text, encoding="utf-8", newline="")
        return paths


class PairLog:
    """Writes the numbers of each pair as soon as they are known: an observer of `evaluate`.

    One line of JSON for each pair, in the order in which they were matched. It is what an evaluation that is ended
    before its time leaves; the first pair of the next one replaces it. `finish` removes it when the files of
    `Evaluation.save` are there.

    Args:
        folder: is made with the first pair.

    >>> import tempfile
    >>> PairLog(tempfile.mkdtemp()).path.name
    'pairs.part.jsonl'
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.path = Path(folder) / "pairs.part.jsonl"
        self._begun = False

    def __call__(self, dataset: str, sample: StereoSample, prediction: Disparity, result: PairResult) -> None:
        """Adds a line.

        Raises:
            InputError: it can't be written.
        """
        make_folder(self.path.parent)
        try:
            with open(self.path, "a" if self._begun else "w", encoding="utf-8") as file:
                file.write(json.dumps({"dataset": dataset, **asdict(result)}) + "\n")
        except OSError as error:
            raise InputError(f"{printable(self.path)} can't be written: {error.strerror or error}") from error
        self._begun = True

    def finish(self) -> None:
        """Removes the file."""
        self.path.unlink(missing_ok=True)


def result_paths(folder: str | os.PathLike[str]) -> list[Path]:
    """The files of an evaluation: everything as JSON, and a row per data set and per pair as CSV.

    >>> [path.name for path in result_paths("evaluation")]
    ['evaluation.json', 'datasets.csv', 'pairs.csv']
    """
    return [Path(folder) / name for name in ("evaluation.json", "datasets.csv", "pairs.csv")]


def _of_one_image(metrics: Metrics) -> Metrics:
    """The metrics that say something about a single image."""
    return {k: v for k, v in metrics.items() if not k.endswith("_per_image") and not k.startswith("images")}


def _cell(value: Any) -> Any:
    """A value as a cell: text that is printable, and that a spreadsheet takes for no formula."""
    if not isinstance(value, str):
        return value
    text = printable(value, most=1000, quoted=False)
    return f"'{text}" if text.startswith(("=", "+", "-", "@")) else text


def _csv(rows: list[dict[str, Any]]) -> str:
    """A table with all columns that occur; what a row does not have is empty."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows({column: _cell(value) for column, value in row.items()} for row in rows)
    return text.getvalue()
