"""Many pairs of files to files of disparity, with a manifest of what became of each."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from stereokit.batch.job import BatchJob, MatchedPair, MoreFiles, NotReplaced, OpenPredictor, difference
from stereokit.batch.manifest import MadeWith, Manifest, PairRecord, Records
from stereokit.batch.processes import Crew
from stereokit.data.pairs import ImagePair
from stereokit.errors import ConfigError, InputError, StereoKitError, printable
from stereokit.files import check_folder, check_free
from stereokit.inference import Predictor
from stereokit.runtime.provenance import file_sha256
from stereokit.tables import counted

__all__ = ["Summary", "Told", "match_files"]


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
    >>> import numpy as np
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
            f"{difference(other[0].made_with, made_with)}; choose another folder, or say --overwrite (overwrite=True) "
            "to match them again"
        )


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
