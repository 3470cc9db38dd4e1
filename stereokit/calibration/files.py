"""Calibration files of any known kind."""

import os
import re
from collections.abc import Callable
from pathlib import Path

from stereokit.calibration.formats.documents import read_document
from stereokit.calibration.formats.foundation_stereo import (
    looks_like_foundation_stereo,
    read_foundation_stereo_calibration,
    write_foundation_stereo_calibration,
)
from stereokit.calibration.formats.kitti import (
    read_drivingstereo_calibration,
    read_kitti_calibration,
    write_kitti_calibration,
)
from stereokit.calibration.formats.middlebury import (
    MILLIMETRE,
    read_middlebury_calibration,
    write_middlebury_calibration,
)
from stereokit.calibration.formats.opencv import read_opencv_calibration, write_opencv_calibration
from stereokit.calibration.formats.ros import read_ros_calibration, ros_pair, write_ros_calibration
from stereokit.calibration.formats.text import keyed_lines, named, read_text
from stereokit.calibration.rectified import FORMAT, Calibration, PathLike
from stereokit.errors import InputError

__all__ = ["LEAST_BASELINE", "MOST_BASELINE", "WRITERS", "read_calibration", "write_calibration"]

LEAST_BASELINE, MOST_BASELINE = 0.005, 5.0
"""In metres. What lies outside has its unit wrong, most often."""


def read_calibration(path: PathLike, *, metres_per_unit: float | None = None) -> Calibration:
    """Reads a calibration file of any known kind, which it finds by looking at the file.

    The library's own JSON; KITTI's (`P0: ...` or `P_rect_02: ...`) and DrivingStereo's (`P_rect_101: ...`);
    Middlebury's and ETH3D's (`cam0=[...]`); OpenCV's YAML, XML or JSON with the results of `cv2.stereoRectify`; ROS's
    camera_info of either camera, whose name says "left" or "right", the other lying beside it; FoundationStereo's
    `K.txt`.

    Args:
        path: the file.
        metres_per_unit: of the file's baseline. By default 0.001 for Middlebury and ETH3D, 1 for the others. That of
            OpenCV's files is in the unit of the calibration board: say 0.001 if that was millimetres.

    Raises:
        InputError: a missing or unreadable file, one of no known kind, or one without the numbers needed; or, where no
            unit is said, a baseline outside 5 mm to 5 m.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "calib.txt"
    >>> _ = path.write_text("cam0=[700 0 320; 0 700 240; 0 0 1]\\ndoffs=5\\nbaseline=100")
    >>> read_calibration(path)
    Calibration(fx=700.0, baseline=0.1, cx0=320.0, cx1=325.0, width=None, height=None, fy=700.0, cy=240.0)
    """
    calibration = _read(path, metres_per_unit)
    # a unit that was said is believed
    if metres_per_unit is None and not LEAST_BASELINE <= calibration.baseline <= MOST_BASELINE:
        raise InputError(
            f"{os.fspath(path)!r}: the baseline is {calibration.baseline:g} m, expected 5 mm to 5 m; if the file has "
            "another unit say metres_per_unit, or 'stereokit calibrate convert FILE NEW --unit mm'"
        )
    return calibration


def _read(path: PathLike, metres_per_unit: float | None) -> Calibration:
    text = read_text(path)
    unit = 1.0 if metres_per_unit is None else metres_per_unit
    if text.lstrip()[:1] == "{" and (values := read_document(path)).get("format") == FORMAT:
        if metres_per_unit is not None:
            raise InputError(f"{os.fspath(path)!r} is in metres; leave out metres_per_unit={metres_per_unit}")
        with named(path):
            return Calibration.from_dict(values)
    if text.lstrip()[:1] in ("{", "<"):
        return read_opencv_calibration(path, metres_per_unit=unit)
    if "cam0" in keyed_lines(text, "="):
        return read_middlebury_calibration(
            path, metres_per_unit=MILLIMETRE if metres_per_unit is None else metres_per_unit
        )
    keys = keyed_lines(text, ":")
    if "projection_matrix" in keys:
        left, right = ros_pair(path)
        return read_ros_calibration(left, right, metres_per_unit=unit)
    if "opencv-matrix" in text or "Q" in keys:
        return read_opencv_calibration(path, metres_per_unit=unit)
    if "P_rect_101" in keys:
        return read_drivingstereo_calibration(path, metres_per_unit=unit)
    if any(re.fullmatch(r"P(_rect_)?\d+", key) for key in keys):
        return read_kitti_calibration(path, metres_per_unit=unit)
    if looks_like_foundation_stereo(text):
        return read_foundation_stereo_calibration(path, metres_per_unit=unit)
    if "T_cn_cnm1" in keys:
        raise InputError(
            f"{os.fspath(path)!r} is a Kalibr camchain, of cameras that are not rectified; rectify the images, see "
            "stereokit.cameras.rig.read_rig"
        )
    raise InputError(
        f"{os.fspath(path)!r} is no calibration that can be read; expected KITTI's lines 'P0: ...' or "
        "'P_rect_02: ...', Middlebury's 'cam0=[...]', ROS's 'projection_matrix', OpenCV's YAML, XML or JSON with the "
        "matrices P1 and P2, FoundationStereo's K.txt, or the library's own JSON"
    )


def write_calibration(
    path: PathLike, calibration: Calibration, *, kind: str | None = None, overwrite: bool = False
) -> None:
    """Writes a calibration file.

    Args:
        path: the file. For "ros" the name says "left" or "right" once, and both files are written.
        calibration: of the rectified pair.
        kind: one of `WRITERS`; by default "stereokit" for .json and "opencv" for .yml, .yaml and .xml.
        overwrite: replace an existing file.

    Raises:
        InputError: an unknown kind, a suffix that does not say one, a calibration without what the format needs, or a
            file that can't be written.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "calib.txt"
    >>> camera = Calibration(700.0, 0.1, 320.0, 325.0, cy=240.0)
    >>> write_calibration(path, camera, kind="middlebury")
    >>> read_calibration(path) == camera
    True
    """
    suffix = Path(path).suffix.lower()
    if kind is None:
        kind = {".json": "stereokit", ".yml": "opencv", ".yaml": "opencv", ".xml": "opencv"}.get(suffix)
    if kind not in WRITERS:
        given = f"got {kind!r}" if kind else f"the suffix {suffix!r} does not say which"
        raise InputError(
            f"{os.fspath(path)!r}: say the kind of calibration, one of {', '.join(map(repr, WRITERS))}; {given}"
        )
    WRITERS[kind](path, calibration, overwrite=overwrite)


def _write_own(path: PathLike, calibration: Calibration, *, overwrite: bool = False) -> None:
    calibration.write(path, overwrite=overwrite)


def _write_ros(path: PathLike, calibration: Calibration, *, overwrite: bool = False) -> None:
    left, right = ros_pair(path)
    write_ros_calibration(left, right, calibration, overwrite=overwrite)


WRITERS: dict[str, Callable[..., None]] = {
    "stereokit": _write_own,
    "opencv": write_opencv_calibration,
    "ros": _write_ros,
    "kitti": write_kitti_calibration,
    "middlebury": write_middlebury_calibration,
    "foundation_stereo": write_foundation_stereo_calibration,
}
"""The kinds of calibration file that `write_calibration` takes by name, each with its writer."""
