"""What became of each pair: a line of JSON, written when its files are whole."""

import errno
import json
import os
import shutil
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from datetime import datetime, timezone
from io import FileIO
from pathlib import Path
from typing import IO, Any, Literal, TypeAlias

from stereokit._version import __version__
from stereokit.errors import InputError, printable
from stereokit.files import make_folder
from stereokit.runtime.provenance import file_sha256

__all__ = ["MANIFEST_NAME", "MadeWith", "Manifest", "PairRecord", "Records"]

MANIFEST_NAME = "manifest.jsonl"
UNFINISHED = ".unfinished"
"""The folder, beside the results, of files of pairs that are not finished."""

MadeWith: TypeAlias = "tuple[str, Mapping[str, Any]]"
"""The SHA-256 of the weights, and the settings that change a result."""


@dataclass(frozen=True, kw_only=True)
class PairRecord:
    """A line of a manifest.

    Attributes:
        pair: its name.
        outcome: "matched", or "failed", of which there are no files.
        left: path of the left image.
        right: of the right one.
        left_sha256: of the left file; None where it can't be read.
        right_sha256: of the right one.
        weights: the SHA-256 of the network's weights.
        settings: all else that changes a result.
        size: height and width.
        disparity: the smallest and the largest finite one, in pixels; None where none is.
        mean_confidence: None where the network gives none.
        seconds: that the network took.
        files: the names of the pair's files, beside the manifest, with their SHA-256.
        error: why it failed.
        time: when it ended, in UTC.
        version: of stereokit.
    """

    pair: str
    outcome: Literal["matched", "failed"]
    left: str
    right: str
    left_sha256: str | None = None
    right_sha256: str | None = None
    weights: str
    settings: Mapping[str, Any]
    size: Sequence[int] | None = None
    disparity: Sequence[float] | None = None
    mean_confidence: float | None = None
    seconds: float | None = None
    files: Mapping[str, str] = field(default_factory=dict)
    error: str | None = None
    time: str = field(default_factory=lambda: datetime.now(timezone.utc).isoformat(timespec="seconds"))
    version: str = __version__

    @property
    def inputs(self) -> tuple[str | None, str | None]:
        """The hashes of both images."""
        return self.left_sha256, self.right_sha256

    @property
    def made_with(self) -> MadeWith:
        """Weights and settings."""
        return self.weights, self.settings

    def to_json(self) -> str:
        """One line, without its end."""
        return json.dumps(asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, line: str | bytes) -> "PairRecord":
        """The record of a line.

        Raises:
            ValueError: it is none.
        """
        values = json.loads(line)
        named = {key.name for key in fields(cls)}
        if not isinstance(values, dict) or not {"pair", "outcome", "weights", "settings", "files"} <= values.keys():
            raise ValueError("no record of a pair")
        # those of another version may say more
        return cls(**{key: value for key, value in values.items() if key in named})

    def damaged(self, folder: Path) -> str | None:
        """The first of the pair's files that is missing, or is not what was written; None where all are whole."""
        for name, written in self.files.items():
            path = folder / name
            if not path.is_file() or file_sha256(path) != written:
                return name
        return None


class Records:
    """The last record of each pair in a manifest, which may not be there. Memory holds only where each one lies.

    Args:
        folder: of the results.

    Raises:
        InputError: a line that is no record. The last one may be cut short, by a kill: it does not count.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.path = Path(folder) / MANIFEST_NAME
        self.end = 0
        """Where the last whole line ends."""
        self._places: dict[str, int] = {}
        self._lock = threading.Lock()
        self._file: IO[bytes] | None = None
        if not self.path.exists():
            return
        try:
            self._file = open(self.path, "rb")  # noqa: SIM115
        except OSError as error:
            raise InputError(f"{printable(self.path)} can't be read: {error.strerror or error}") from error
        for number, line in enumerate(self._file, start=1):
            if not line.endswith(b"\n"):
                break
            self._places[self._parsed(line, number).pair] = self.end
            self.end += len(line)

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[PairRecord]:
        return (record for name in self._places if (record := self.get(name)) is not None)

    def get(self, pair: str) -> PairRecord | None:
        """The last record of a pair, as it was when the manifest was opened; threads may ask at once."""
        place = self._places.get(pair)
        if place is None or self._file is None:
            return None
        with self._lock:
            self._file.seek(place)
            return self._parsed(self._file.readline(), None)

    def close(self) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()

    def _parsed(self, line: bytes, number: int | None) -> PairRecord:
        try:
            return PairRecord.from_json(line)
        except (ValueError, TypeError) as error:
            where = "" if number is None else f", line {number}"
            raise InputError(
                f"{printable(self.path)}{where} is no record of a pair; repair or remove it, or choose another folder"
            ) from error


class Manifest:
    """The manifest of a folder of results, open to be added to by one process at a time.

    The files of a pair are written into `staging`. `finish` adds the record, then moves them to their places: a kill
    leaves whole pairs, and at most one whose record names files that are not there, which counts as damaged.

    Args:
        folder: of the results; is made if need be.
        end: of what is kept of the file that is there, see `Records`.

    Raises:
        InputError: the folder or the file can't be written, or another process adds to it.
    """

    def __init__(self, folder: str | os.PathLike[str], *, end: int = 0) -> None:
        self.folder = Path(folder)
        self.staging = self.folder / UNFINISHED
        make_folder(self.folder)
        path = self.folder / MANIFEST_NAME
        try:
            # unbuffered: what is written is there
            self._file = open(path, "ab", buffering=0)  # noqa: SIM115
            _lock(self._file, self.folder)
            self._file.truncate(end)
            # of a run that was killed
            shutil.rmtree(self.staging, ignore_errors=True)
            self.staging.mkdir()
        except OSError as error:
            raise InputError(f"{printable(path)} can't be written: {error.strerror or error}") from error

    def __enter__(self) -> "Manifest":
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.staging, ignore_errors=True)
        self._file.close()

    def finish(self, record: PairRecord, planned: Sequence[str]) -> None:
        """Adds a record, and moves the files that it names from `staging` to their places.

        Args:
            record: of a pair.
            planned: names of all files that the pair may have; of a matched pair those that it has not are removed.

        Raises:
            InputError: a file can't be written.
        """
        line = record.to_json().encode() + b"\n"
        end = self._file.seek(0, os.SEEK_END)
        try:
            if self._file.write(line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            # half a line would spoil the next one
            self._file.truncate(end)
            raise InputError(f"{str(self._file.name)!r} can't be written: {error.strerror or error}") from error
        try:
            for name in planned:
                if name in record.files:
                    os.replace(self.staging / name, self.folder / name)
                elif record.outcome == "matched":
                    (self.folder / name).unlink(missing_ok=True)
                else:
                    (self.staging / name).unlink(missing_ok=True)
        except OSError as error:
            raise InputError(f"{str(self.folder / name)!r} can't be written: {error.strerror or error}") from error


def _lock(file: FileIO, folder: Path) -> None:
    try:
        import fcntl
    except ImportError:  # no such lock on Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise InputError(
            f"another process writes results into {printable(folder)}; wait for it, or choose another folder"
        ) from error
