"""What is done to each of many pairs: read, matched, written."""

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from torch import Tensor

from stereokit.backends.exported import ExportedBackend
from stereokit.batch.manifest import MadeWith, PairRecord, Records
from stereokit.batch.pipeline import run_pipeline
from stereokit.data.inputs import to_pair
from stereokit.data.pairs import ImagePair
from stereokit.errors import InputError, StereoKitError, printable
from stereokit.files import read_file_bytes
from stereokit.inference import DisparityResult, Predictor, output_paths
from stereokit.runtime.provenance import file_sha256

__all__ = ["BatchJob", "MatchedPair", "MoreFiles", "NotReplaced", "OpenPredictor", "difference"]


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


def difference(before: MadeWith, now: MadeWith) -> str:
    """Says in words what two results were made with that differs."""
    if before[0] != now[0]:
        return "other weights"
    changed = sorted(key for key in {*before[1], *now[1]} if before[1].get(key) != now[1].get(key))
    values = (f"{key} {before[1].get(key)!r}, not {now[1].get(key)!r}" for key in changed if key != "network")
    return f"other settings ({'; '.join(values) or 'another network'})"


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
                again = difference(known.made_with, self.made_with)
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
