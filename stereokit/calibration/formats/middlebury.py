"""Middlebury's and ETH3D's `calib.txt`: camera matrices, in millimetres."""

from stereokit.calibration.formats.text import keyed_lines, needed, numbers, read_text, rectified, row, write_text
from stereokit.calibration.rectified import Calibration, PathLike
from stereokit.errors import InputError

__all__ = ["MILLIMETRE", "read_middlebury_calibration", "write_middlebury_calibration"]

MILLIMETRE = 0.001


def read_middlebury_calibration(path: PathLike, *, metres_per_unit: float = MILLIMETRE) -> Calibration:
    """Reads Middlebury's and ETH3D's `calib.txt`, whose baseline is in millimetres.

    Args:
        path: the file.
        metres_per_unit: of the file's baseline.

    Raises:
        InputError: a missing or malformed file, or one without cam0, baseline, and doffs or cam1.

    Source: https://vision.middlebury.edu/stereo/data/scenes2014/.
    """
    lines = keyed_lines(read_text(path), "=")
    left = numbers(path, "cam0", needed(path, lines, "cam0").strip("[]"), 9)
    if "doffs" in lines:
        right = [*left[:2], left[2] + numbers(path, "doffs", lines["doffs"], 1)[0], *left[3:]]
    else:
        right = numbers(path, "cam1", needed(path, lines, "cam1").strip("[]"), 9)
    baseline = numbers(path, "baseline", needed(path, lines, "baseline"), 1)[0]
    size = [numbers(path, side, lines[side], 1)[0] for side in ("width", "height") if side in lines]
    if len(size) == 1:
        raise InputError(f"{str(path)!r} has one of the lines 'width' and 'height'; expected both or neither")
    return rectified(
        path,
        _projection(left, 0.0),
        _projection(right, baseline),
        size=size or None,
        metres_per_unit=metres_per_unit,
    )


def write_middlebury_calibration(path: PathLike, calibration: Calibration, *, overwrite: bool = False) -> None:
    """Writes Middlebury's `calib.txt`, in millimetres.

    Raises:
        InputError: `calibration` does not say cy, or the file can't be written.
    """
    fx, fy, cy = (float(value) for value in (calibration.fx, calibration.fy, calibration.known_cy()))
    cameras = [f"[{fx!r} 0 {float(cx)!r}; 0 {fy!r} {cy!r}; 0 0 1]" for cx in (calibration.cx0, calibration.cx1)]
    lines = [
        f"cam0={cameras[0]}",
        f"cam1={cameras[1]}",
        f"doffs={row([calibration.doffs])}",
        f"baseline={row([calibration.baseline / MILLIMETRE])}",
    ]
    if calibration.width is not None:
        lines += [f"width={calibration.width}", f"height={calibration.height}"]
    write_text(path, "\n".join(lines) + "\n", overwrite=overwrite)


def _projection(camera: list[float], x: float) -> list[float]:
    return [*camera[:3], -camera[0] * x, *camera[3:6], 0.0, *camera[6:], 0.0]
