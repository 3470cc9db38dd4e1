"""Files that appear whole or not at all."""

import json
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stereokit.errors import InputError, printable

__all__ = ["atomic_path", "check_folder", "check_free", "make_folder", "read_file_bytes", "write_json"]

MAX_FILE_BYTES = 2**29
"""The most that is read of one file as a whole."""


@contextmanager
def atomic_path(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary file name that becomes `path` when the block ends without an error.

    The temporary lies in the folder of `path` and has its suffix, so writers that choose a format by the
    suffix work. When the block raises, the temporary is removed and `path` is as it was. A symbolic link is
    followed.

    Args:
        path: the file to write.
        overwrite: replace an existing file.

    Yields:
        The temporary path, which does not exist yet.

    Raises:
        InputError: `path` exists and `overwrite` is False, it is no regular file, its folder does not
            exist, or the file can't be written.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with atomic_path(folder / "note.txt") as temporary:
    ...     _ = temporary.write_text("whole")
    >>> (folder / "note.txt").read_text()
    'whole'
    """
    target = Path(os.path.realpath(path))
    _check_target(target, path, overwrite=overwrite)
    temporary = target.with_name(f".{target.stem[:64]}.{secrets.token_hex(6)}{target.suffix}")
    try:
        yield temporary
        _check_target(target, path, overwrite=overwrite)
        temporary.replace(target)
    except OSError as error:
        raise InputError(f"{os.fspath(path)!r} can't be written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def read_file_bytes(path: str | os.PathLike[str], limit: int | None = None) -> bytes:
    """The content of a regular file, or its first `limit` bytes.

    Raises:
        InputError: no such file, a folder, a device, a file that may not be read, or without a limit one of more than
            `MAX_FILE_BYTES`.
    """
    name = printable(path)
    try:
        if not os.path.exists(path):
            raise InputError(f"{name} does not exist")
        if not os.path.isfile(path):
            kind = "a folder" if os.path.isdir(path) else "a device or a pipe"
            raise InputError(f"{name} is {kind}; expected a file")
        if limit is None and os.path.getsize(path) > MAX_FILE_BYTES:
            raise InputError(f"{name} has {os.path.getsize(path)} bytes; expected at most {MAX_FILE_BYTES}")
        with open(path, "rb") as file:
            return file.read() if limit is None else file.read(limit)
    except OSError as error:
        raise InputError(f"{name} can't be read: {error.strerror or error}") from error


def write_json(path: str | os.PathLike[str], values: Mapping[str, Any], *, overwrite: bool = False) -> None:
    """Writes a record as JSON, whole or not at all.

    Raises:
        InputError: see `atomic_path`.
    """
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def make_folder(folder: str | os.PathLike[str]) -> None:
    """Makes a folder and those above it, if need be.

    Raises:
        InputError: it can't be made.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder {os.fspath(folder)!r} can't be made: {error.strerror or error}") from error


def check_folder(folder: str | os.PathLike[str]) -> None:
    """Makes nothing, and finds out whether files could be written into a folder, which may have to be made.

    Raises:
        InputError: it can't be made, or nothing can be written into it.
    """
    wanted = Path(folder).absolute()
    # the root is always there
    there = next(place for place in (wanted, *wanted.parents) if os.path.lexists(place))
    reason = None
    if not there.is_dir():
        reason = "is a file" if there.is_file() else "is no folder"
    elif not os.access(there, os.W_OK | os.X_OK):
        reason = "may not be written to"
    if reason is not None:
        place = "it" if there == wanted else repr(str(there))
        raise InputError(
            f"files can't be written into the folder {os.fspath(folder)!r}: {place} {reason}; choose another folder"
        )


def check_free(paths: list[Path], *, overwrite: bool) -> None:
    """Raises `InputError` if a file to be written exists already and `overwrite` was not said."""
    taken = [] if overwrite else [str(path) for path in paths if path.exists()]
    if taken:
        more = f", and so do {len(taken) - 1} more" if len(taken) > 1 else ""
        raise InputError(
            f"{taken[0]!r} exists already{more}; choose another folder, or say --overwrite (overwrite=True)"
        )


def _check_target(target: Path, given: str | os.PathLike[str], *, overwrite: bool) -> None:
    name = os.fspath(given)
    if not target.parent.is_dir():
        raise InputError(f"{name!r} can't be written: the folder {os.fspath(Path(given).parent)!r} does not exist")
    if target.exists() and not target.is_file():
        raise InputError(f"{name!r} can't be written: it exists and is not a regular file")
    if target.exists() and not overwrite:
        raise InputError(f"{name!r} exists already; choose another name, or say overwrite=True to replace it")
