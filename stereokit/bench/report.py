"""What a benchmark found: as a table, as JSON and as a plot."""

import importlib.util
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from stereokit.bench.budget import Budget
from stereokit.bench.stages import REST
from stereokit.errors import ConfigError
from stereokit.files import atomic_path
from stereokit.runtime.memory import format_memory
from stereokit.tables import Table, counted, share

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Benchmark", "Row", "check_plot"]

NONE = "-"
PLOT_SUFFIXES = (".png", ".svg", ".pdf")


@dataclass(frozen=True)
class Row:
    """One candidate.

    Attributes:
        name, backend, precision, height, width, batch: see `Candidate`.
        max_disparity: D, in pixels.
        iterations: of a recurrent network.
        parameters: learned numbers.
        multiply_adds: of convolutions and matrix products, for the whole batch.
        first_seconds: from building to the end of the first run, compilation included.
        peak_memory: bytes that building and running it added to what the process held, weights included, see
            `PeakMemory`.
        seconds: of every timed run of the whole batch, in the order of the rounds.
        median_seconds, p95_seconds: of them.
        pairs_per_second: batch / median_seconds.
        ratio: seconds per pair, in parts of those of the first row that has any.
        share_of_limit: 2 multiply_adds / median_seconds, in parts of the peak of a matrix product.
        stages: median seconds by stage.
        error: why it could not be timed; None for a row that could.
    """

    name: str
    backend: str
    precision: str
    height: int
    width: int
    batch: int
    max_disparity: int | None
    iterations: int | None = None
    parameters: int | None = None
    multiply_adds: int | None = None
    first_seconds: float | None = None
    peak_memory: int | None = None
    seconds: tuple[float, ...] = ()
    median_seconds: float | None = None
    p95_seconds: float | None = None
    pairs_per_second: float | None = None
    ratio: float | None = None
    share_of_limit: float | None = None
    stages: dict[str, float] | None = None
    error: str | None = None


@dataclass(frozen=True)
class Benchmark:
    """The rows, and all that is needed to repeat them.

    Attributes:
        rows: in the order of the candidates.
        budget: what the hardware can do, if it was measured.
        settings: the device, the numbers of runs, the seed.
        machine: see `stereokit.runtime.provenance.machine`.
        versions: of Python and the libraries.
        started: time in UTC, ISO 8601.
        load: processes that wanted to run before and after, on average over a minute; other programs among them.
        command: the command line, if there was one.
    """

    rows: tuple[Row, ...]
    budget: Budget | None
    settings: dict[str, Any]
    machine: dict[str, Any]
    versions: dict[str, str]
    started: str
    load: tuple[float | None, ...]
    command: str | None

    @property
    def failed(self) -> bool:
        """Whether no candidate could be timed."""
        return all(row.error is not None for row in self.rows)

    def to_json(self) -> str:
        """Everything, as strict JSON."""
        return json.dumps(asdict(self), indent=2, allow_nan=False) + "\n"

    def table(self) -> Table:
        """A row per candidate; what all of them share is left out, see `heading`."""
        columns: list[tuple[str, list[str]]] = [
            ("network", [row.name for row in self.rows]),
            *((heading, cells) for heading, cells in self._identities() if len(set(cells)) > 1),
            ("median [ms]", [_milliseconds(row.median_seconds) for row in self.rows]),
            ("p95 [ms]", [_milliseconds(row.p95_seconds) for row in self.rows]),
            ("pairs/s", [_number(row.pairs_per_second, ".2f") for row in self.rows]),
            ("ratio", [_number(row.ratio, ".2f") for row in self.rows]),
            ("memory", [NONE if row.peak_memory is None else format_memory(row.peak_memory) for row in self.rows]),
            ("parameters", [_number(row.parameters, ",") for row in self.rows]),
            ("GMACs", [NONE if m is None else f"{m / 1e9:.2f}" for m in (row.multiply_adds for row in self.rows)]),
            ("first run [s]", [_number(row.first_seconds, ".2f") for row in self.rows]),
        ]
        if self.budget is not None:
            shares = (row.share_of_limit for row in self.rows)
            columns.append(("of the limit", [NONE if s is None else share(s, 1) for s in shares]))
        return _table(columns)

    def stage_table(self) -> Table | None:
        """Milliseconds by stage, a row per candidate that was split; None without any."""
        split = [row for row in self.rows if row.stages]
        if not split:
            return None
        found = dict.fromkeys(stage for row in split for stage in row.stages or {})
        # last, also where a later network has stages that the first one lacks
        stages = [*(stage for stage in found if stage != REST), *(stage for stage in found if stage == REST)]
        columns = [("network", [row.name for row in split])]
        columns += [(heading, cells) for heading, cells in self._identities(split) if len(set(cells)) > 1]
        columns += [(stage, [_milliseconds((row.stages or {}).get(stage)) for row in split]) for stage in stages]
        columns.append(("sum", [_milliseconds(sum((row.stages or {}).values())) for row in split]))
        return _table(columns)

    def heading(self) -> str:
        """What all rows share, the machine and its load, in a few lines."""
        common = [
            f"{name} {cells[0]}" for name, cells in self._identities() if len(set(cells)) == 1 and cells[0] != NONE
        ]
        where = ", ".join([self.machine["processor"], *self.machine["accelerators"]])
        load = " to ".join(NONE if value is None else f"{value:.2f}" for value in self.load)
        lines = [
            f"{', '.join(common)}; device {self.settings['device']}, "
            f"{self.settings['repeats']} runs after {self.settings['warmup']}, in turns",
            f"{where}, {self.machine['cores']} cores, "
            f"{counted(self.machine['torch_threads'], 'thread')}, load {load}, "
            f"torch {self.versions.get('torch', NONE)}",
        ]
        if self.budget is not None:
            peaks = ", ".join(f"{peak / 1e9:,.0f} GFLOP/s in {name}" for name, peak in self.budget.flops.items())
            lines.append(
                f"limits measured here: matrix product {peaks or NONE}; "
                f"memory copy {self.budget.copy_bytes / 1e9:.1f} GB/s read and written"
            )
        return "\n".join(lines)

    def __str__(self) -> str:
        """Heading, table, stages and failures, as lines of text."""
        parts = [self.heading(), str(self.table())]
        stages = self.stage_table()
        if stages is not None:
            parts.append(f"milliseconds by stage\n{stages}")
        failures = [f"{_label(row)}: {row.error}" for row in self.rows if row.error is not None]
        if failures:
            parts.append("\n".join(["not timed", *failures]))
        return "\n\n".join(parts)

    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Writes the JSON.

        Raises:
            InputError: the file exists already, or can't be written.
        """
        with atomic_path(path, overwrite=overwrite) as temporary:
            temporary.write_text(self.to_json(), encoding="utf-8")

    def figure(self) -> "Figure":
        """A bar per candidate: the median, with a mark at the 95th percentile. Needs matplotlib (extra viz)."""
        from matplotlib.figure import Figure

        rows = [row for row in self.rows if row.median_seconds is not None]
        figure = Figure(figsize=(8, 1.6 + 0.4 * len(rows)), layout="constrained")
        axes = figure.add_subplot()
        medians = [1000 * (row.median_seconds or 0) for row in rows]
        tails = [1000 * (row.p95_seconds or 0) - median for row, median in zip(rows, medians, strict=True)]
        bars = axes.barh(range(len(rows)), medians, xerr=[[0] * len(rows), tails], capsize=3)
        axes.bar_label(bars, [f" {median:.1f} ms" for median in medians], padding=4)
        axes.set_yticks(range(len(rows)), [self._tick(row) for row in rows])
        axes.invert_yaxis()
        axes.margins(x=0.15)
        axes.set_xlabel("median per run, mark at the 95th percentile [ms]")
        axes.set_title(self.heading().splitlines()[1], fontsize="small")
        return figure

    def save_plot(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Writes the figure in the format of the suffix: .png, .svg or .pdf.

        Raises:
            ConfigError: see `check_plot`.
            InputError: the file exists already, or can't be written.
        """
        check_plot(path)
        figure = self.figure()
        with atomic_path(path, overwrite=overwrite) as temporary:
            figure.savefig(temporary, dpi=150)

    def _identities(self, rows: Sequence[Row] | None = None) -> list[tuple[str, list[str]]]:
        """What tells candidates of one network apart, as columns."""
        rows = self.rows if rows is None else rows
        return [
            ("backend", [row.backend for row in rows]),
            ("precision", [row.precision for row in rows]),
            ("size", [f"{row.height} x {row.width}" for row in rows]),
            ("batch", [str(row.batch) for row in rows]),
            ("D", [NONE if row.max_disparity is None else str(row.max_disparity) for row in rows]),
            ("iterations", [NONE if row.iterations is None else str(row.iterations) for row in rows]),
        ]

    def _tick(self, row: Row) -> str:
        index = self.rows.index(row)
        parts = [cells[index] for _, cells in self._identities() if len(set(cells)) > 1]
        return " ".join([row.name, *parts])


def check_plot(path: str | os.PathLike[str]) -> None:
    """Raises `ConfigError` unless a plot can be written in the format of the suffix."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ConfigError("a plot needs matplotlib: pip install 'stereokit[viz]'")
    suffix = os.path.splitext(path)[1].lower()
    if suffix not in PLOT_SUFFIXES:
        raise ConfigError(f"{os.fspath(path)!r}: a plot can't be written as {suffix!r}; use .png, .svg or .pdf")


def _label(row: Row) -> str:
    size = f"{row.height} x {row.width}"
    return f"{row.name} {row.backend} {row.precision} {size}, batch {row.batch}, D {row.max_disparity or 'its own'}"


def _table(columns: Sequence[tuple[str, Sequence[str]]]) -> Table:
    headings, cells = zip(*columns, strict=True)
    return Table(tuple(headings), tuple(zip(*cells, strict=True)))


def _milliseconds(seconds: float | None) -> str:
    return NONE if seconds is None else f"{1000 * seconds:.1f}"


def _number(value: float | None, form: str) -> str:
    return NONE if value is None else format(value, form)
