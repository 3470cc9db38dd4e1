"""What the formats share: text read within bounds, numbers out of it, and errors that name the file."""

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from stereokit.calibration.rectified import Calibration, PathLike
from stereokit.errors import InputError
from stereokit.files import atomic_path, read_file_bytes

__all__ = [
    "MAX_BYTES",
    "keyed_lines",
    "named",
    "needed",
    "numbers",
    "projection",
    "read_text",
    "rectified",
    "row",
    "write_text",
]

MAX_BYTES = 2**20
"""The most that a calibration file may have."""

_SAME_FOCAL_LENGTH = 1e-3  # relative


def read_text(path: PathLike) -> str:
    """The text of a calibration file, without a byte order mark.

    Raises:
        InputError: no such file, no regular file, one that may not be read, or more than `MAX_BYTES`.
    """
    data = read_file_bytes(path, MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise InputError(f"{os.fspath(path)!r} is no calibration: it has more than {MAX_BYTES} bytes")
    wide = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    return data.decode("utf-16" if wide else "utf-8-sig", errors="replace")


def write_text(path: PathLike, text: str, *, overwrite: bool) -> None:
    """Writes a file, whole or not at all."""
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_text(text, encoding="utf-8")


def keyed_lines(text: str, separator: str) -> dict[str, str]:
    """The lines `key<separator>value` of a text, whose keys are single words; others are passed over.

    >>> keyed_lines(" width = 3 \\n\\nno line\\ntwo words=1", "=")
    {'width': '3'}
    """
    parts = (line.partition(separator) for line in text.splitlines())
    return {key.strip(): value.strip() for key, found, value in parts if found and re.fullmatch(r"\s*\w+\s*", key)}


def needed(path: PathLike, lines: Mapping[str, str], key: str) -> str:
    """The value of a key.

    Raises:
        InputError: it is not there.
    """
    if key not in lines:
        raise InputError(f"{os.fspath(path)!r} has no line {key!r}; it has {', '.join(lines)[:200] or 'none'}")
    return lines[key]


def numbers(path: PathLike, key: str, text: str | Sequence[object], count: int) -> list[float]:
    """So many finite numbers, from text between blanks, commas or semicolons, or from a list.

    Raises:
        InputError: another number of them, or something else.
    """
    words = re.split(r"[\s,;]+", text.strip()) if isinstance(text, str) else text
    try:
        # a list may hold anything that JSON has
        values = [float(word) for word in words if isinstance(word, str | int | float)] if len(words) == count else []
    except (ValueError, OverflowError):
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        shown = text if isinstance(text, str) else ", ".join(str(word)[:20] for word in text[:8])
        raise InputError(f"{os.fspath(path)!r}: expected {count} numbers for {key}, got {shown[:80]!r}")
    return values


@contextmanager
def named(path: PathLike) -> Iterator[None]:
    """Puts the name of the file before an error that arises in the block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{os.fspath(path)!r}: {error}") from error


def rectified(
    path: PathLike,
    left: Sequence[float],
    right: Sequence[float],
    *,
    size: Sequence[float] | None,
    metres_per_unit: float = 1.0,
) -> Calibration:
    """The calibration of two projection matrices 3 x 4 of rectified cameras, row by row.

    A matrix is f 0 cx -f x | 0 fy cy ... | 0 0 1 0 for a camera that stands at x, so that the baseline is
    (P_left[0, 3] - P_right[0, 3]) / f.

    Args:
        path: of the file, for errors.
        left: of the left camera, 12 numbers.
        right: of the right camera.
        size: width and height, or None.
        metres_per_unit: of the last column.

    Raises:
        InputError: the cameras have different focal lengths, or are none.
    """
    if abs(left[0] - right[0]) > _SAME_FOCAL_LENGTH * abs(left[0]):
        raise InputError(
            f"{os.fspath(path)!r}: the focal lengths of the two cameras are {left[0]:g} and {right[0]:g} px; "
            "a rectified pair has one, so rectify the pair first"
        )
    width, height = (None, None) if size is None else map(int, size)
    with named(path):
        return Calibration(
            fx=left[0],
            baseline=(left[3] - right[3]) / left[0] * metres_per_unit if left[0] else math.nan,
            cx0=left[2],
            cx1=right[2],
            width=width,
            height=height,
            # some write a dummy there
            fy=left[5] if left[5] > 0 else math.nan,
            cy=left[6],
        )


def projection(calibration: Calibration, side: str) -> list[float]:
    """The projection matrix 3 x 4 of the "left" or "right" camera in metres, row by row, which `rectified` takes."""
    right = side == "right"
    shift = -calibration.fx * calibration.baseline if right else 0.0
    cx = calibration.cx1 if right else calibration.cx0
    first, second = [calibration.fx, 0.0, cx, shift], [0.0, calibration.fy, calibration.known_cy(), 0.0]
    return [*first, *second, 0.0, 0.0, 1.0, 0.0]


def row(values: Iterable[float], separator: str = " ") -> str:
    """Numbers as text that gives the same numbers when it is read."""
    return separator.join(repr(float(value)) for value in values)
