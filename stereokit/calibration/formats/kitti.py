"""KITTI's and DrivingStereo's calibration: projection matrices, a line each."""

import math
import os
import re
from dataclasses import replace

from stereokit.calibration.formats.text import (
    keyed_lines,
    named,
    needed,
    numbers,
    projection,
    read_text,
    rectified,
    row,
    write_text,
)
from stereokit.calibration.rectified import Calibration, PathLike
from stereokit.errors import InputError

__all__ = ["read_drivingstereo_calibration", "read_kitti_calibration", "write_kitti_calibration"]

_PAIRS = (("2", "3"), ("02", "03"), ("0", "1"), ("00", "01"))
_DRIVINGSTEREO_PAIR = ("101", "103")


def read_kitti_calibration(
    path: PathLike, *, cameras: tuple[str, str] | None = None, metres_per_unit: float = 1.0
) -> Calibration:
    """Reads KITTI's calibration: rectified projection matrices `P0:` (2012) or `P_rect_00:` (2015, raw).

    The baseline is (P_left[0, 3] - P_right[0, 3]) / fx.

    Args:
        path: the file.
        cameras: the numbers of the left and the right camera as the file writes them. By default the colour
            pair 2 and 3, else the grey pair 0 and 1.
        metres_per_unit: of the file's baseline.

    Raises:
        InputError: a missing or malformed file, or one without those cameras.

    Source: the readme of KITTI's development kits.
    """
    lines = keyed_lines(read_text(path), ":")
    projections = {
        key.removeprefix("P_rect_").removeprefix("P"): value
        for key, value in lines.items()
        if re.fullmatch(r"P(_rect_)?\d+", key)
    }
    pair = cameras or next((pair for pair in _PAIRS if projections.keys() >= set(pair)), None)
    if pair is None or not projections.keys() >= set(pair):
        raise InputError(
            f"{os.fspath(path)!r} has the cameras {', '.join(projections)[:200] or 'none'}; expected "
            f"{' and '.join(cameras) if cameras else 'a pair of them, such as 2 and 3'}"
        )
    left, right = (numbers(path, f"P{camera}", projections[camera], 12) for camera in pair)
    size = lines.get(f"S_rect_{pair[0]}")
    return rectified(
        path,
        left,
        right,
        size=None if size is None else numbers(path, "S_rect", size, 2),
        metres_per_unit=metres_per_unit,
    )


def read_drivingstereo_calibration(path: PathLike, *, metres_per_unit: float = 1.0) -> Calibration:
    """Reads DrivingStereo's calibration, in KITTI's form for the cameras 101 and 103.

    The baseline is the length of `T_103`, the position of the right camera. The last column of `P_rect_103`
    gives twice as much in the files for half-size images.

    Args:
        path: the file.
        metres_per_unit: of the file's baseline.

    Raises:
        InputError: a missing or malformed file, or one without those cameras.

    Source: https://drivingstereo-dataset.github.io/.
    """
    lines = keyed_lines(read_text(path), ":")
    calibration = read_kitti_calibration(path, cameras=_DRIVINGSTEREO_PAIR)
    translation = numbers(path, "T_103", needed(path, lines, "T_103"), 3)
    with named(path):
        return replace(calibration, baseline=math.hypot(*translation) * metres_per_unit)


def write_kitti_calibration(path: PathLike, calibration: Calibration, *, overwrite: bool = False) -> None:
    """Writes KITTI's calibration of 2015, for the cameras 02 (left) and 03 (right), in metres.

    Raises:
        InputError: `calibration` does not say cy, or the file can't be written.
    """
    lines = []
    for camera, side in (("02", "left"), ("03", "right")):
        if calibration.width is not None and calibration.height is not None:
            lines.append(f"S_rect_{camera}: {row([calibration.width, calibration.height])}\n")
        lines.append(f"P_rect_{camera}: {row(projection(calibration, side))}\n")
    write_text(path, "".join(lines), overwrite=overwrite)
