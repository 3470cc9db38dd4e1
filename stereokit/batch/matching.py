"""Many pairs of files to files of disparity, with a manifest of what became of each."""

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from torch import Tensor

from stereokit.backends.exported import ExportedBackend
from stereokit.batch.manifest import MadeWith, Manifest, PairRecord, Records
from stereokit.batch.pipeline import run_pipeline
from stereokit.batch.processes import Crew
from stereokit.data.inputs import to_pair
from stereokit.data.pairs import ImagePair
from stereokit.errors import ConfigError, InputError, StereoKitError, printable
from stereokit.files import check_folder, check_free, read_file_bytes
from stereokit.inference import DisparityResult, Predictor, output_paths
from stereokit.runtime.provenance import file_sha256
from stereokit.tables import counted

__all__ = ["BatchJob", "MatchedPair", "MoreFiles", "OpenPredictor", "Summary", "Told", "match_files"]


class OpenPredictor(Protocol):
    """Opens the network; where several processes match, it is called in each of them, so it must be picklable."""

    def __call__(self, device: str | None, /) -> Predictor:
        """The predictor on a device, or on that of its own choice."""


class MoreFiles(Protocol):
    """Makes further files of a pair, such as depth; picklable."""

    @property
    def settings(self) -> dict[str, Any]:
        """What changes the files, in plain JSON."""

    def names(self, pair: str) -> list[str]:
        """Of the files of a pair."""

    def compute(self, predictor: Predictor, left: Tensor, right: Tensor, result: DisparityResult) -> Any:
        """What needs the network, in its thread; `write` gets it. Images are (1, 3, H, W)."""

    def write(self, folder: Path, pair: str, result: DisparityResult, computed: Any) -> list[str]:
        """Writes the files into a folder, and says so in lines."""


@dataclass(frozen=True)
class MatchedPair:
    """What became of a pair.

    Attributes:
        pair: the files.
        record: its line in the manifest.
        done_before: nothing was done: the files were there, whole, of these images, weights and settings.
        again: why it was matched although it had been before; None where it had not.
        invalid: pixels without a finite disparity.
        preparation_seconds: see `DisparityResult`.
        notes: what `MoreFiles.write` said.
    """

    pair: ImagePair
    record: PairRecord
    done_before: bool = False
    again: str | None = None
    invalid: int = 0
    preparation_seconds: float = 0.0
    notes: tuple[str, ...] = ()


Told = Callable[[ImagePair, "MatchedPair | StereoKitError"], None]


@dataclass
class Summary:
    """Counts of a run over many pairs.

    Attributes:
        matched: pairs that were matched.
        done_before: that had been.
        failed: names of those that could not be.
        network_seconds: that the network took to be made ready and to run, in all processes together.
        seconds: that passed, once the network was opened.
        processes: that matched.
    """

    matched: int = 0
    done_before: int = 0
    failed: list[str] = field(default_factory=list)
    network_seconds: float = 0.0
    seconds: float = 0.0
    processes: int = 1

    @property
    def rate(self) -> float:
        """Pairs matched in a second."""
        return self.matched / self.seconds if self.seconds else 0.0

    @property
    def busy(self) -> float:
        """The share of the time that the network ran, from 0 to 1."""
        return self.network_seconds / (self.seconds * self.processes) if self.seconds else 0.0


@dataclass(frozen=True)
class BatchJob:
    """What is done to each pair; picklable.

    Args:
        pairs: all of them.
        out: folder of the results.
        open_predictor: opens the network.
        more: further files.
        workers: threads that read, and as many that write.
        overwrite: replace files that are there.
    """

    pairs: Sequence[ImagePair]
    out: Path
    open_predictor: OpenPredictor
    more: MoreFiles | None
    workers: int
    overwrite: bool

    def names(self, pair: str) -> list[str]:
        """Of all files that a pair may have."""
        return [*(path.name for path in output_paths("", pair)), *(self.more.names(pair) if self.more else [])]

    def made_with(self, predictor: Predictor) -> MadeWith:
        """The hash of the predictor's weights, and all settings that change a result."""
        described = predictor.describe()
        backend = predictor.backend
        weights = described.pop("weights_sha256", None)
        if isinstance(backend, ExportedBackend):
            weights = file_sha256(backend.path)
            binary = Path(backend.path).with_suffix(".bin")
            if binary.is_file() and Path(backend.path).suffix == ".xml":
                weights += file_sha256(binary)
        network = {key: described.pop(key) for key in ("configuration", "class", "export") if key in described}
        described["device"] = predictor.device.type
        settings = {
            **described,
            "network": hashlib.sha256(json.dumps(network, sort_keys=True, default=str).encode()).hexdigest(),
            **(self.more.settings if self.more else {}),
        }
        # as it is read from the manifest
        return weights or "", json.loads(json.dumps(settings, default=str))

    def run(
        self,
        predictor: Predictor,
        made_with: MadeWith,
        records: Records,
        staging: Path,
        turns: Iterable[int],
        tell: Callable[[int, "MatchedPair | StereoKitError"], None],
    ) -> None:
        """Matches the pairs of these numbers; their files come to lie in `staging`."""
        work = _Work(self, predictor, made_with, records, staging)
        run_pipeline(turns, read=work.read, compute=work.compute, write=work.write, tell=tell, workers=self.workers)


class NotReplaced(InputError):
    """A whole result of other images is there, and is not to be replaced."""


def match_files(
    pairs: Sequence[ImagePair],
    open_predictor: OpenPredictor | Predictor,
    out: str | os.PathLike[str],
    *,
    more: MoreFiles | None = None,
    workers: int = 2,
    processes: int = 1,
    devices: Sequence[str] = (),
    overwrite: bool = False,
    tell: Told = lambda pair, outcome: None,
) -> Summary:
    """Matches many pairs of image files, and writes what `DisparityResult.save_all` writes for each.

    Images are read and results written in threads beside the network. Of each pair `manifest.jsonl`, beside the
    results, gets a line: a `PairRecord`. A pair whose record is there, of the same images, weights and settings, and
    whose files are whole, is done already. One whose files are damaged or missing is matched again; so is one of other
    images, weights or settings, if `overwrite` says so. A run that was killed goes on where it was.

    Args:
        pairs: see `stereokit.data.pairs.match_pairs`.
        open_predictor: the network, or with several processes what opens it in each of them.
        out: folder for results; is made if need be.
        more: makes further files of each pair.
        workers: threads that read, and as many that write, in each process; with 0 all is done one after the other.
        processes: that match at once, each with a network of its own and a share of the threads that torch computes
            with. A script that starts more than one must guard its main part by `if __name__ == "__main__"`.
        devices: of the processes, in turn; by default each chooses.
        overwrite: replace whole results of other images, weights or settings, and files that no manifest names.
        tell: is told of each pair in order: what became of it, or why it failed.

    Returns:
        The counts. Pairs that fail are told and recorded, and the others are matched all the same.

    Raises:
        InputError: files that are not to be replaced, a manifest that can't be read, two pairs of one name, or a folder
            that can't be written.
        ConfigError: numbers that can't be.
        StereoKitError: a network that can't be opened.

    >>> import tempfile
    >>> from stereokit.data import write_image
    >>> from stereokit.data.pairs import match_pairs
    >>> folder = Path(tempfile.mkdtemp())
    >>> for name in ("a_L.png", "b_L.png", "a_R.png", "b_R.png"):
    ...     write_image(folder / name, np.zeros((40, 50, 3), np.uint8))
    >>> pairs = match_pairs(folder / "*_L.png", folder / "*_R.png")
    >>> predictor = Predictor("coex", device="cpu")
    >>> match_files(pairs, predictor, folder / "out").matched
    2
    >>> match_files(pairs, predictor, folder / "out").done_before
    2
    """
    if workers < 0 or processes < 1:
        raise ConfigError(f"expected at least 0 workers and 1 process, got {workers} and {processes}")
    if isinstance(open_predictor, Predictor):
        if processes > 1:
            raise ConfigError(f"{processes} processes need a function that opens the network in each, not a Predictor")
        open_predictor = partial(_given, open_predictor)
    if len({pair.name for pair in pairs}) < len(pairs):
        raise InputError("two pairs have one name, and so would their results")
    check_folder(out)
    job = BatchJob(pairs, Path(out), open_predictor, more, workers, overwrite)
    records = Records(out)
    try:
        unknown = [pair.name for pair in pairs if records.get(pair.name) is None]
        check_free([job.out / name for pair in unknown for name in job.names(pair)], overwrite=overwrite)
        return _match(job, records, tell, processes, devices)
    finally:
        records.close()


def _match(job: BatchJob, records: Records, tell: Told, processes: int, devices: Sequence[str]) -> Summary:
    summary = Summary(processes=processes)
    crew = Crew(job, processes, devices) if processes > 1 else None
    try:
        if crew:
            made_with = crew.made_with
        else:
            predictor = job.open_predictor(devices[0] if devices else None)
            made_with = job.made_with(predictor)
        _check_made_with(job, records, made_with)
        with Manifest(job.out, end=records.end) as manifest:
            told = partial(_finish, job, manifest, made_with, summary, tell)
            start = time.perf_counter()
            try:
                if crew:
                    crew.run(manifest.staging, told)
                else:
                    job.run(predictor, made_with, records, manifest.staging, range(len(job.pairs)), told)
            finally:
                summary.seconds = time.perf_counter() - start
    finally:
        if crew:
            crew.close()
    return summary


def _given(predictor: Predictor, device: str | None) -> Predictor:
    return predictor


def _check_made_with(job: BatchJob, records: Records, made_with: MadeWith) -> None:
    """Refuses to replace what was made with other weights or settings."""
    if job.overwrite:
        return
    other = [
        record
        for pair in job.pairs
        if (record := records.get(pair.name))
        and record.made_with != made_with
        and any((job.out / name).exists() for name in record.files)
    ]
    if other:
        raise InputError(
            f"{counted(len(other), 'result')} in {printable(job.out)} {'was' if len(other) == 1 else 'were'} made with "
            f"{_difference(other[0].made_with, made_with)}; choose another folder, or say --overwrite (overwrite=True) "
            "to match them again"
        )


def _difference(before: MadeWith, now: MadeWith) -> str:
    if before[0] != now[0]:
        return "other weights"
    changed = sorted(key for key in {*before[1], *now[1]} if before[1].get(key) != now[1].get(key))
    values = (f"{key} {before[1].get(key)!r}, not {now[1].get(key)!r}" for key in changed if key != "network")
    return f"other settings ({'; '.join(values) or 'another network'})"


def _finish(
    job: BatchJob,
    manifest: Manifest,
    made_with: MadeWith,
    summary: Summary,
    tell: Told,
    turn: int,
    outcome: MatchedPair | StereoKitError,
) -> None:
    pair = job.pairs[turn]
    if isinstance(outcome, StereoKitError):
        summary.failed.append(pair.name)
        if not isinstance(outcome, NotReplaced):
            manifest.finish(
                PairRecord(
                    pair=pair.name,
                    outcome="failed",
                    left=str(pair.left),
                    right=str(pair.right),
                    left_sha256=_hash_of(pair.left),
                    right_sha256=_hash_of(pair.right),
                    weights=made_with[0],
                    settings=made_with[1],
                    error=str(outcome),
                ),
                job.names(pair.name),
            )
    elif outcome.done_before:
        summary.done_before += 1
    else:
        manifest.finish(outcome.record, job.names(pair.name))
        summary.matched += 1
        summary.network_seconds += outcome.preparation_seconds + (outcome.record.seconds or 0.0)
    tell(pair, outcome)


def _hash_of(path: Path) -> str | None:
    try:
        return file_sha256(path)
    except InputError:
        return None


@dataclass(frozen=True)
class _Views:
    left: Tensor
    right: Tensor
    hashes: tuple[str, str]
    again: str | None


@dataclass(frozen=True)
class _Computed:
    views: _Views
    result: DisparityResult
    more: Any


class _Work:
    """The three stages of the pipeline, for the number of a pair."""

    def __init__(
        self, job: BatchJob, predictor: Predictor, made_with: MadeWith, records: Records, staging: Path
    ) -> None:
        self.job = job
        self.bit_depth = predictor.bit_depth
        self.predictor = predictor.for_read_views()
        self.made_with = made_with
        self.records = records
        self.staging = staging

    def read(self, turn: int) -> "_Views | MatchedPair":
        pair = self.job.pairs[turn]
        left, right = (hashlib.sha256(read_file_bytes(path)).hexdigest() for path in (pair.left, pair.right))
        known = self.records.get(pair.name)
        again = None
        if known is not None and known.outcome == "matched":
            if known.made_with != self.made_with:
                again = _difference(known.made_with, self.made_with)
            elif (damaged := known.damaged(self.job.out)) is not None:
                again = f"{damaged} is missing or damaged"
            elif known.inputs == (left, right):
                return MatchedPair(pair, known, done_before=True)
            elif self.job.overwrite:
                again = "other images"
            else:
                raise NotReplaced(
                    f"the result in {printable(self.job.out)} is of other images; choose another folder, or say "
                    "--overwrite (overwrite=True)"
                )
        return _Views(*to_pair(pair.left, pair.right, bit_depth=self.bit_depth), (left, right), again)

    def compute(self, turn: int, views: "_Views | MatchedPair") -> "_Computed | MatchedPair":
        if isinstance(views, MatchedPair):
            return views
        result = self.predictor(views.left, views.right)
        more = self.job.more
        return _Computed(views, result, more.compute(self.predictor, views.left, views.right, result) if more else None)

    def write(self, turn: int, computed: "_Computed | MatchedPair") -> MatchedPair:
        if isinstance(computed, MatchedPair):
            return computed
        pair, job, views, result = self.job.pairs[turn], self.job, computed.views, computed.result
        result.save_all(self.staging, pair.name, overwrite=True)
        notes = job.more.write(self.staging, pair.name, result, computed.more) if job.more else []
        there = [name for name in job.names(pair.name) if (self.staging / name).is_file()]
        weights, settings = self.made_with
        record = PairRecord(
            pair=pair.name,
            outcome="matched",
            left=str(pair.left),
            right=str(pair.right),
            left_sha256=views.hashes[0],
            right_sha256=views.hashes[1],
            weights=weights,
            settings=settings,
            size=list(result.size),
            disparity=result.known_range,
            mean_confidence=result.mean_confidence,
            seconds=result.seconds,
            files={name: file_sha256(self.staging / name) for name in there},
        )
        return MatchedPair(
            pair,
            record,
            again=views.again,
            invalid=result.invalid,
            preparation_seconds=result.preparation_seconds,
            notes=tuple(notes),
        )
