"""ROS's camera_info: a YAML file for each camera of the pair."""

import os
from pathlib import Path
from typing import Any

from stereokit.calibration.formats.documents import find_size, matrix, read_document
from stereokit.calibration.formats.text import projection, rectified, row
from stereokit.calibration.rectified import Calibration, PathLike
from stereokit.errors import InputError
from stereokit.files import atomic_path

__all__ = ["read_ros_calibration", "ros_pair", "write_ros_calibration"]


def read_ros_calibration(left: PathLike, right: PathLike, *, metres_per_unit: float = 1.0) -> Calibration:
    """Reads the camera_info of both cameras: their rectified projection matrices.

    The baseline is (P_left[0, 3] - P_right[0, 3]) / fx.

    Args:
        left: of the left camera, YAML with `projection_matrix`, `image_width` and `image_height`.
        right: of the right camera.
        metres_per_unit: of the baseline; ROS uses metres.

    Raises:
        InputError: a missing or malformed file, two sizes, or a pair that is not rectified or swapped.

    Source: the documentation of `sensor_msgs/CameraInfo` and of `camera_calibration_parsers`.
    """
    documents = [read_document(path) for path in (left, right)]
    first, second = (
        matrix(path, document, "projection_matrix", (3, 4))
        for path, document in zip((left, right), documents, strict=True)
    )
    sizes = [find_size(path, document) for path, document in zip((left, right), documents, strict=True)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"{os.fspath(left)!r} is for images of {_size_text(sizes[0])} pixels, {os.fspath(right)!r} of "
            f"{_size_text(sizes[1])}; expected one size"
        )
    return rectified(right, first, second, size=sizes[0], metres_per_unit=metres_per_unit)


def write_ros_calibration(
    left: PathLike, right: PathLike, calibration: Calibration, *, overwrite: bool = False
) -> None:
    """Writes the camera_info of both cameras, for images that are rectified: without distortion or rotation.

    Raises:
        InputError: `calibration` does not say cy or the size of the images, or a file can't be written.
    """
    if calibration.width is None:
        raise InputError("ROS's camera_info needs the size of the images; use calibration.sized(height, width)")
    if os.path.realpath(left) == os.path.realpath(right):
        raise InputError(f"{os.fspath(left)!r} can't be the file of both cameras")
    with atomic_path(left, overwrite=overwrite) as first, atomic_path(right, overwrite=overwrite) as second:
        for side, file in (("left", first), ("right", second)):
            file.write_text(_camera_info(calibration, side), encoding="utf-8")


def ros_pair(path: PathLike) -> tuple[Path, Path]:
    """The files of both cameras from that of one, whose name says "left" or "right" once.

    Raises:
        InputError: it does not.

    >>> [path.name for path in ros_pair("camera_left.yaml")]
    ['camera_left.yaml', 'camera_right.yaml']
    """
    path = Path(path)
    for side, other in (("left", "right"), ("right", "left")):
        if path.name.count(side) == 1 and other not in path.name:
            partner = path.with_name(path.name.replace(side, other))
            return (path, partner) if side == "left" else (partner, path)
    raise InputError(
        f"{str(path)!r} is of one camera of a pair; use read_ros_calibration(left, right), or name the files after "
        "'left' and 'right'"
    )


def _camera_info(calibration: Calibration, side: str) -> str:
    matrix_of_side = projection(calibration, side)
    camera = [*matrix_of_side[:3], *matrix_of_side[4:7], 0.0, 0.0, 1.0]
    entries: list[tuple[str, int, int, list[float]]] = [
        ("camera_matrix", 3, 3, camera),
        ("distortion_coefficients", 1, 5, [0.0] * 5),
        ("rectification_matrix", 3, 3, [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0]),
        ("projection_matrix", 3, 4, matrix_of_side),
    ]
    lines = [f"image_width: {calibration.width}", f"image_height: {calibration.height}", f"camera_name: {side}"]
    for key, rows, columns, values in entries:
        if key == "distortion_coefficients":
            lines.append("distortion_model: plumb_bob")
        lines += [f"{key}:", f"  rows: {rows}", f"  cols: {columns}", f"  data: [{row(values, ', ')}]"]
    return "\n".join(lines) + "\n"


def _size_text(size: Any) -> str:
    return "unknown" if size is None else f"{size[0]:g} x {size[1]:g}"
