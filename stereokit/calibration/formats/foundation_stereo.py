"""FoundationStereo's `K.txt`: the camera matrix in one line, the baseline in metres in the next."""

import os

from stereokit.calibration.formats.text import named, numbers, read_text, row, write_text
from stereokit.calibration.rectified import Calibration, PathLike
from stereokit.errors import InputError

__all__ = ["looks_like_foundation_stereo", "read_foundation_stereo_calibration", "write_foundation_stereo_calibration"]


def looks_like_foundation_stereo(text: str) -> bool:
    """Whether a text is two lines of numbers, nine and one."""
    lines = [line.split() for line in text.splitlines() if line.strip()]
    return [len(words) for words in lines] == [9, 1]


def read_foundation_stereo_calibration(path: PathLike, *, metres_per_unit: float = 1.0) -> Calibration:
    """Reads `K.txt`. It knows one principal point, which is that of both views, and no size.

    Args:
        path: the file.
        metres_per_unit: of the file's baseline.

    Raises:
        InputError: a missing or malformed file.

    Source: the readme of NVlabs/FoundationStereo.
    """
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    if len(lines) != 2:
        raise InputError(f"{os.fspath(path)!r}: expected two lines, K and the baseline, got {len(lines)}")
    matrix = numbers(path, "K", lines[0], 9)
    with named(path):
        return Calibration(
            fx=matrix[0],
            fy=matrix[4],
            cx0=matrix[2],
            cx1=matrix[2],
            cy=matrix[5],
            baseline=numbers(path, "the baseline", lines[1], 1)[0] * metres_per_unit,
        )


def write_foundation_stereo_calibration(path: PathLike, calibration: Calibration, *, overwrite: bool = False) -> None:
    """Writes `K.txt`.

    Raises:
        InputError: the principal points of the views differ, which the format can't say; `calibration` does not say
            cy; or the file can't be written.
    """
    if calibration.cx0 != calibration.cx1:
        raise InputError(
            f"{os.fspath(path)!r}: K.txt knows one principal point, the calibration has cx0 = {calibration.cx0:g} and "
            f"cx1 = {calibration.cx1:g}; crop one view so that they are equal, or use another format"
        )
    matrix = [calibration.fx, 0, calibration.cx0, 0, calibration.fy, calibration.known_cy(), 0, 0, 1]
    write_text(path, f"{row(matrix)}\n{row([calibration.baseline])}\n", overwrite=overwrite)
