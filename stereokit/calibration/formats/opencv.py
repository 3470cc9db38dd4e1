"""OpenCV's YAML, XML and JSON with the results of `cv2.stereoRectify`."""

import math
import os
from pathlib import Path

import cv2
import numpy as np

from stereokit.calibration.formats.documents import find_size, is_matrix, matrix, read_document
from stereokit.calibration.formats.text import named, projection, rectified, write_text
from stereokit.calibration.rectified import Calibration, PathLike
from stereokit.errors import InputError

__all__ = ["SUFFIXES", "read_opencv_calibration", "write_opencv_calibration"]

SUFFIXES = (".yml", ".yaml", ".xml", ".json")
"""Of OpenCV's files."""


def read_opencv_calibration(path: PathLike, *, metres_per_unit: float = 1.0) -> Calibration:
    """Reads an OpenCV YAML, XML or JSON file with the matrices P1 and P2, or Q, of `cv2.stereoRectify`.

    The size is read from `image_size`, or from `image_width` and `image_height`, where the file has them.

    Args:
        path: the file.
        metres_per_unit: of the baseline, whose unit is that of the calibration board.

    Raises:
        InputError: a missing or malformed file, or one without these matrices.

    Source: OpenCV's documentation of `stereoRectify` and `FileStorage`.
    """
    document = read_document(path)
    size = find_size(path, document)
    if {"P1", "P2"} <= document.keys():
        left, right = (matrix(path, document, key, (3, 4)) for key in ("P1", "P2"))
        return rectified(path, left, right, size=size, metres_per_unit=metres_per_unit)
    if "Q" not in document:
        matrices = ", ".join(key for key, value in document.items() if is_matrix(value))[:200]
        raise InputError(
            f"{os.fspath(path)!r} holds the matrices {matrices or 'none'}; "
            "expected P1 and P2, or Q, which cv2.stereoRectify gives"
        )
    q = matrix(path, document, "Q", (4, 4))
    baseline = 1 / q[14] if q[14] else math.nan
    width, height = (None, None) if size is None else map(int, size)
    with named(path):
        return Calibration(
            fx=q[11],
            baseline=baseline * metres_per_unit,
            cx0=-q[3],
            cx1=-q[3] + q[15] * baseline,
            width=width,
            height=height,
            cy=-q[7],
        )


def write_opencv_calibration(path: PathLike, calibration: Calibration, *, overwrite: bool = False) -> None:
    """Writes P1, P2, Q and the size as OpenCV does, in metres, as YAML, XML or JSON by the suffix.

    Q, which knows one focal length, is left out where fx differs from fy.

    Raises:
        InputError: another suffix, `calibration` does not say cy, or the file can't be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{os.fspath(path)!r}: OpenCV's calibration is written as {', '.join(SUFFIXES)}")
    matrices = {f"P{i + 1}": np.reshape(projection(calibration, side), (3, 4)) for i, side in enumerate(_SIDES)}
    if calibration.fx == calibration.fy:
        q = np.eye(4)
        q[:3, 3] = -calibration.cx0, -calibration.known_cy(), calibration.fx
        q[2, 2] = 0
        q[3, 2:] = 1 / calibration.baseline, calibration.doffs / calibration.baseline
        matrices["Q"] = q
    # written to memory; only the suffix counts
    storage = cv2.FileStorage(f"calibration{suffix}", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    if calibration.width is not None and calibration.height is not None:
        storage.write("image_width", calibration.width)
        storage.write("image_height", calibration.height)
    for key, values in matrices.items():
        storage.write(key, values)
    write_text(path, storage.releaseAndGetString(), overwrite=overwrite)


_SIDES = ("left", "right")
