"""The geometry of a rectified pair, from the calibration files of the benchmarks and of OpenCV."""

import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from stereokit.data.images import read_file_bytes
from stereokit.errors import InputError

__all__ = [
    "Calibration",
    "read_calibration",
    "read_drivingstereo_calibration",
    "read_kitti_calibration",
    "read_middlebury_calibration",
    "read_opencv_calibration",
]

PathLike: TypeAlias = "str | os.PathLike[str]"

_MAX_BYTES = 2**20
_MILLIMETRE = 0.001
_KITTI_LINE = re.compile(r"^\s*([A-Za-z]\w*):[ \t]*(.*)$", re.MULTILINE)
_KITTI_PROJECTION = re.compile(r"^\s*P(?:_rect_)?\d+:", re.MULTILINE)
_KITTI_PAIRS = (("2", "3"), ("02", "03"), ("0", "1"), ("00", "01"))
_DRIVINGSTEREO_PAIR = ("101", "103")
_MIDDLEBURY_LINE = re.compile(r"^\s*(\w+)\s*=[ \t]*(.*?)\s*$", re.MULTILINE)
_OPENCV_MATRIX = re.compile(
    r"^\s*(\w+):\s*!!opencv-matrix\s+rows:\s*(\d{1,6})\s+cols:\s*(\d{1,6})\s+dt:\s*\"?\w+\"?\s+data:\s*\[([^\[\]]*)\]",
    re.MULTILINE,
)
_OPENCV_SIZE = re.compile(r"^\s*image_?[sS]ize:\s*\[\s*(\d{1,9})\s*,\s*(\d{1,9})\s*\]", re.MULTILINE)
_OPENCV_SIDE = r"^\s*(?:image_)?%s:\s*(\d{1,9})\s*$"


@dataclass(frozen=True)
class Calibration:
    """A rectified pair of cameras: what turns disparity into depth.

    Attributes:
        fx: focal length in pixels, of both views.
        baseline: distance of the cameras in metres.
        cx0: column of the principal point in the left view, in pixels.
        cx1: the same in the right view. `cx1 - cx0` is what Middlebury calls doffs.
        width: of the images in pixels, or None where the file does not say.
        height: the same.

    Raises:
        InputError: a focal length or baseline that is not positive, or a value that is not finite.

    >>> camera = Calibration(fx=700.0, baseline=0.5, cx0=320.0, cx1=320.0, width=640, height=480)
    >>> float(camera.depth(10.0))
    35.0
    """

    fx: float
    baseline: float
    cx0: float
    cx1: float
    width: int | None = None
    height: int | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.fx) and self.fx > 0):
            raise InputError(f"calibration: the focal length must be a positive number of pixels, got {self.fx}")
        if not (math.isfinite(self.baseline) and self.baseline > 0):
            raise InputError(
                f"calibration: the baseline must be a positive number of metres, got {self.baseline}; "
                "a negative one means that the views are swapped"
            )
        if not (math.isfinite(self.cx0) and math.isfinite(self.cx1)):
            raise InputError(f"calibration: the principal points must be finite, got {self.cx0} and {self.cx1}")
        for side in (self.width, self.height):
            if side is not None and side < 1:
                raise InputError(f"calibration: the image size must be positive, got {self.width} x {self.height}")

    def depth(self, disparity: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Depth along the optical axis, Z = baseline * fx / (d + cx1 - cx0).

        Args:
            disparity: of any shape, in pixels at the resolution of this calibration.

        Returns:
            Metres, of the same shape. NaN where the disparity is unknown (NaN, infinite, or 0 and no
            offset) and where it would lie behind the camera.

        Source: Middlebury stereo 2014, description of the calibration file.
        """
        shift = np.asarray(disparity, np.float64) + (self.cx1 - self.cx0)
        with np.errstate(divide="ignore", invalid="ignore"):
            metres = self.baseline * self.fx / shift
        return np.where(np.isfinite(shift) & (shift > 0), metres, np.nan).astype(np.float32)


def read_calibration(path: PathLike, *, metres_per_unit: float | None = None) -> Calibration:
    """Reads a calibration file of any known kind, which it finds by looking at the file.

    KITTI's (`P0: ...` or `P_rect_02: ...`), DrivingStereo's (`P_rect_101: ...`), Middlebury's and ETH3D's
    (`cam0=[...]`), and OpenCV's YAML with the results of `cv2.stereoRectify`.

    Args:
        path: the file.
        metres_per_unit: of the file's baseline. By default 1 for KITTI, 0.001 for Middlebury and ETH3D, and
            1 for OpenCV, whose baseline is in the unit of the calibration board: say 0.001 if that was
            millimetres.

    Raises:
        InputError: a missing or unreadable file, one of no known kind, or one without the numbers needed.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "calib.txt"
    >>> _ = path.write_text("cam0=[700 0 320; 0 700 240; 0 0 1]\\ndoffs=5\\nbaseline=100")
    >>> read_calibration(path)
    Calibration(fx=700.0, baseline=0.1, cx0=320.0, cx1=325.0, width=None, height=None)
    """
    text = _read_text(path)
    if "!!opencv-matrix" in text:
        return read_opencv_calibration(path, metres_per_unit=metres_per_unit or 1.0)
    if "cam0" in dict(_MIDDLEBURY_LINE.findall(text)):
        return read_middlebury_calibration(path, metres_per_unit=metres_per_unit or _MILLIMETRE)
    if re.search(r"^\s*P_rect_101:", text, re.MULTILINE):
        return read_drivingstereo_calibration(path, metres_per_unit=metres_per_unit or 1.0)
    if _KITTI_PROJECTION.search(text):
        return read_kitti_calibration(path, metres_per_unit=metres_per_unit or 1.0)
    raise InputError(
        f"{os.fspath(path)!r} is no calibration that can be read; expected KITTI's lines 'P0: ...' or "
        "'P_rect_02: ...', Middlebury's 'cam0=[...]', or OpenCV's YAML with the matrices P1 and P2"
    )


def read_kitti_calibration(
    path: PathLike, *, cameras: tuple[str, str] | None = None, metres_per_unit: float = 1.0
) -> Calibration:
    """Reads KITTI's calibration: rectified projection matrices `P0:` (2012) or `P_rect_00:` (2015, raw).

    The baseline is (P_left[0, 3] - P_right[0, 3]) / fx.

    Args:
        path: the file.
        cameras: the numbers of the left and the right camera as the file writes them. By default the colour
            pair 2 and 3, else the grey pair 0 and 1, else DrivingStereo's 101 and 103.
        metres_per_unit: of the file's baseline.

    Raises:
        InputError: a missing or malformed file, or one without those cameras.

    Source: the readme of KITTI's development kits.
    """
    name = os.fspath(path)
    lines = dict(_KITTI_LINE.findall(_read_text(path)))
    projections = {
        key.removeprefix("P_rect_").removeprefix("P"): value
        for key, value in lines.items()
        if re.fullmatch(r"P(_rect_)?\d+", key)
    }
    pair = cameras or next((pair for pair in _KITTI_PAIRS if projections.keys() >= set(pair)), None)
    if pair is None or not projections.keys() >= set(pair):
        raise InputError(
            f"{name!r} has the cameras {', '.join(projections) or 'none'}; expected "
            f"{' and '.join(cameras) if cameras else 'a pair of them, such as 2 and 3'}"
        )
    left, right = (_numbers(path, f"P{camera}", projections[camera], 12) for camera in pair)
    size = lines.get(f"S_rect_{pair[0]}")
    width, height = _numbers(path, "S_rect", size, 2) if size is not None else (None, None)
    return _calibration(
        path,
        fx=left[0],
        baseline=_ratio(left[3] - right[3], left[0]) * metres_per_unit,
        cx0=left[2],
        cx1=right[2],
        width=width,
        height=height,
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
    lines = dict(_KITTI_LINE.findall(_read_text(path)))
    calibration = read_kitti_calibration(path, cameras=_DRIVINGSTEREO_PAIR)
    translation = _numbers(path, "T_103", _needed(path, lines, "T_103"), 3)
    return replace(calibration, baseline=math.hypot(*translation) * metres_per_unit)


def read_middlebury_calibration(path: PathLike, *, metres_per_unit: float = _MILLIMETRE) -> Calibration:
    """Reads Middlebury's and ETH3D's `calib.txt`, whose baseline is in millimetres.

    Args:
        path: the file.
        metres_per_unit: of the file's baseline.

    Raises:
        InputError: a missing or malformed file, or one without cam0, baseline, and doffs or cam1.

    Source: https://vision.middlebury.edu/stereo/data/scenes2014/.
    """
    lines = dict(_MIDDLEBURY_LINE.findall(_read_text(path)))
    camera = _numbers(path, "cam0", _needed(path, lines, "cam0").strip("[]"), 9)
    if "doffs" in lines:
        cx1 = camera[2] + _numbers(path, "doffs", lines["doffs"], 1)[0]
    else:
        cx1 = _numbers(path, "cam1", _needed(path, lines, "cam1").strip("[]"), 9)[2]
    width, height = (_numbers(path, side, lines[side], 1)[0] if side in lines else None for side in ("width", "height"))
    return _calibration(
        path,
        fx=camera[0],
        baseline=_numbers(path, "baseline", _needed(path, lines, "baseline"), 1)[0] * metres_per_unit,
        cx0=camera[2],
        cx1=cx1,
        width=width,
        height=height,
    )


def read_opencv_calibration(path: PathLike, *, metres_per_unit: float = 1.0) -> Calibration:
    """Reads an OpenCV YAML file with the matrices P1 and P2, or Q, of `cv2.stereoRectify`.

    The size is read from `image_size`, or from `image_width` and `image_height`, where the file has them.

    Args:
        path: the file.
        metres_per_unit: of the baseline, whose unit is that of the calibration board.

    Raises:
        InputError: a missing or malformed file, or one without these matrices.

    Source: OpenCV's documentation of `stereoRectify` and `FileStorage`.
    """
    text = _read_text(path)
    matrices = {key: (int(rows), int(columns), data) for key, rows, columns, data in _OPENCV_MATRIX.findall(text)}
    width: float | None
    height: float | None
    if size := _OPENCV_SIZE.search(text):
        width, height = int(size[1]), int(size[2])
    else:
        sides = (re.search(_OPENCV_SIDE % side, text, re.MULTILINE) for side in ("width", "height"))
        width, height = (int(side[1]) if side else None for side in sides)
    if {"P1", "P2"} <= matrices.keys():
        left, right = (_matrix(path, matrices, key, (3, 4)) for key in ("P1", "P2"))
        fx, cx0, cx1 = left[0], left[2], right[2]
        baseline = _ratio(left[3] - right[3], left[0])
    elif "Q" in matrices:
        q = _matrix(path, matrices, "Q", (4, 4))
        baseline = _ratio(1, q[14])
        fx, cx0, cx1 = q[11], -q[3], -q[3] + q[15] * baseline
    else:
        raise InputError(
            f"{os.fspath(path)!r} holds the matrices {', '.join(matrices) or 'none'}; "
            "expected P1 and P2, or Q, which cv2.stereoRectify gives"
        )
    return _calibration(path, fx=fx, baseline=baseline * metres_per_unit, cx0=cx0, cx1=cx1, width=width, height=height)


def _read_text(path: PathLike) -> str:
    data = read_file_bytes(path, _MAX_BYTES + 1)
    if len(data) > _MAX_BYTES:
        raise InputError(f"{os.fspath(path)!r} is no calibration: it has more than {_MAX_BYTES} bytes")
    return data.decode("utf-8", errors="replace")


def _needed(path: PathLike, lines: Mapping[str, str], key: str) -> str:
    if key not in lines:
        raise InputError(f"{os.fspath(path)!r} has no line {key!r}; it has {', '.join(lines)[:200] or 'none'}")
    return lines[key]


def _numbers(path: PathLike, key: str, text: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in re.split(r"[\s,;]+", text.strip())]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{os.fspath(path)!r}: expected {count} numbers for {key}, got {text[:80]!r}")
    return values


def _matrix(
    path: PathLike, matrices: Mapping[str, tuple[int, int, str]], key: str, shape: tuple[int, int]
) -> list[float]:
    rows, columns, data = matrices[key]
    if (rows, columns) != shape:
        raise InputError(
            f"{os.fspath(path)!r}: expected a {shape[0]} x {shape[1]} matrix {key}, got {rows} x {columns}"
        )
    return _numbers(path, key, data, rows * columns)


def _ratio(numerator: float, denominator: float) -> float:
    return numerator / denominator if denominator else math.nan


def _calibration(
    path: PathLike,
    *,
    fx: float,
    baseline: float,
    cx0: float,
    cx1: float,
    width: float | None,
    height: float | None,
) -> Calibration:
    """A calibration whose error names the file."""
    whole_width, whole_height = (None if side is None else int(side) for side in (width, height))
    try:
        return Calibration(fx, baseline, cx0, cx1, whole_width, whole_height)
    except InputError as error:
        raise InputError(f"{os.fspath(path)!r}: {error}") from error
