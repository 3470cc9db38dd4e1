"""Two cameras as they are before rectification."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.calibration.files import LEAST_BASELINE, MOST_BASELINE
from stereokit.calibration.formats.documents import read_document
from stereokit.calibration.formats.kalibr import KalibrCamera, read_kalibr
from stereokit.calibration.formats.text import keyed_lines, named, numbers, read_text
from stereokit.calibration.rectified import Calibration, PathLike
from stereokit.calibration.versioned import check_version
from stereokit.errors import InputError
from stereokit.files import write_json

__all__ = ["Camera", "Model", "Rig", "is_rig", "read_rig"]

Model: TypeAlias = Literal["pinhole", "fisheye"]

_FORMAT = "stereokit rig"
_VERSION = 1
_COEFFICIENTS = {"pinhole": (0, 4, 5, 8, 12, 14), "fisheye": (4,)}


@dataclass(frozen=True)
class Camera:
    """One camera with its lens.

    Attributes:
        fx: focal length along the rows in pixels.
        fy: the same along the columns.
        cx: column of the principal point; pixel centres lie at whole numbers.
        cy: row of it.
        width: of the images in pixels.
        height: likewise.
        distortion: the coefficients in OpenCV's order: none, k1 k2 p1 p2, and on to k3, or k3 to k6 and more
            ("pinhole"); k1 to k4 ("fisheye").
        model: OpenCV's model of the lens.

    Raises:
        InputError: values that are not finite, focal lengths or a size that are not positive, or another number of
            coefficients.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()
    model: Model = "pinhole"

    def __post_init__(self) -> None:
        if self.model not in _COEFFICIENTS:
            raise InputError(f"camera: the model is 'pinhole' or 'fisheye', got {str(self.model)[:40]!r}")
        if len(self.distortion) not in _COEFFICIENTS[self.model]:
            counts = ", ".join(map(str, _COEFFICIENTS[self.model]))
            raise InputError(
                f"camera: the {self.model} model has {counts} coefficients of distortion, got {len(self.distortion)}"
            )
        if not np.isfinite([self.fx, self.fy, self.cx, self.cy, *self.distortion]).all():
            raise InputError("camera: focal lengths, principal point and distortion must be finite")
        if min(self.fx, self.fy, self.width, self.height) <= 0:
            raise InputError(
                f"camera: focal lengths and size must be positive, got {self.fx:g}, {self.fy:g} and "
                f"{self.width} x {self.height}"
            )

    @property
    def matrix(self) -> npt.NDArray[np.float64]:
        """The camera matrix, 3 x 3."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    @property
    def coefficients(self) -> npt.NDArray[np.float64]:
        """The distortion as OpenCV's functions take it: at least four numbers."""
        return np.array(self.distortion or (0.0,) * 4)

    def scaled(self, *, height: int, width: int) -> "Camera":
        """The camera whose images are resized: f' = s f and c' = (c + 0.5) s - 0.5; the lens stays as it is.

        Raises:
            InputError: a size that is not positive, or another aspect ratio by more than rounding.

        >>> Camera(500.0, 500.0, 319.5, 239.5, 640, 480).scaled(height=240, width=320)
        Camera(fx=250.0, fy=250.0, cx=159.5, cy=119.5, width=320, height=240, distortion=(), model='pinhole')
        """
        pair = Calibration(self.fx, 1.0, self.cx, self.cx, self.width, self.height, self.fy, self.cy)
        resized = pair.scaled(height=height, width=width)
        return replace(
            self, fx=resized.fx, fy=resized.fy, cx=resized.cx0, cy=resized.known_cy(), width=width, height=height
        )

    def project(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Where the camera sees points (N, 3) of its own axes, in metres: (N, 2), column and row.

        >>> Camera(500.0, 500.0, 319.5, 239.5, 640, 480).project(np.array([[0.1, 0.0, 1.0]])).tolist()
        [[369.5, 239.5]]
        """
        nothing = np.zeros(3)
        found, _ = self._lens.projectPoints(points.reshape(-1, 1, 3), nothing, nothing, self.matrix, self.coefficients)
        return np.asarray(found, np.float64).reshape(-1, 2)

    def rays(self, pixels: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The directions (N, 3), with z = 1, in which the camera sees pixels (N, 2), less than 90 degrees off its axis.

        >>> Camera(500.0, 500.0, 319.5, 239.5, 640, 480).rays(np.array([[369.5, 239.5]])).tolist()
        [[0.1, 0.0, 1.0]]
        """
        given = np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2)
        found = np.asarray(self._lens.undistortPoints(given, self.matrix, self.coefficients)).reshape(-1, 2)
        return np.concatenate([found, np.ones((len(found), 1))], axis=1)

    @property
    def _lens(self) -> Any:
        """OpenCV's functions for the model."""
        return cv2.fisheye if self.model == "fisheye" else cv2


@dataclass(frozen=True)
class Rig:
    """Two cameras and how they stand: X_right = R X_left + T, in metres.

    Attributes:
        left: the left camera.
        right: the right camera, of the same size of images.
        rotation: R, row by row.
        translation: T, about (-baseline, 0, 0).

    Raises:
        InputError: images of two sizes, no rotation, or cameras that no rectification makes a left and a right one:
            swapped, one above the other, or closer than 5 mm or farther than 5 m.
    """

    left: Camera
    right: Camera
    rotation: tuple[float, ...]
    translation: tuple[float, ...]

    def __post_init__(self) -> None:
        left, right = self.left, self.right
        if (left.width, left.height) != (right.width, right.height):
            raise InputError(
                f"rig: the left camera has images of {left.width} x {left.height} pixels, the right one of "
                f"{right.width} x {right.height}; expected one size"
            )
        if len(self.rotation) != 9 or len(self.translation) != 3:
            raise InputError("rig: expected a rotation of 9 numbers, row by row, and a translation of 3")
        rotation = np.reshape(self.rotation, (3, 3))
        if not (np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0):
            raise InputError("rig: R is no rotation")
        across, down, _ = self.translation
        if not (LEAST_BASELINE <= self.baseline <= MOST_BASELINE):
            raise InputError(
                f"rig: the baseline is {self.baseline:g} m; expected 5 mm to 5 m; check the unit of the board"
            )
        if abs(across) < abs(down):
            raise InputError(
                f"rig: the cameras stand one above the other, T = {_text(self.translation)} m; turn both views by 90 "
                "degrees"
            )
        if across > 0:
            raise InputError(f"rig: the views are swapped, T = {_text(self.translation)} m; exchange left and right")

    @property
    def baseline(self) -> float:
        """Distance of the cameras in metres."""
        return float(np.linalg.norm(self.translation))

    def scaled(self, *, height: int, width: int) -> "Rig":
        """The rig whose images are resized, see `Camera.scaled`.

        Raises:
            InputError: a size that is not positive, or another aspect ratio by more than rounding.

        >>> camera = Camera(500.0, 500.0, 319.5, 239.5, 640, 480)
        >>> rig = Rig(camera, camera, (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0), (-0.1, 0.0, 0.0))
        >>> rig.scaled(height=240, width=320).right.fx
        250.0
        """
        left, right = (camera.scaled(height=height, width=width) for camera in (self.left, self.right))
        return replace(self, left=left, right=right)

    def to_dict(self) -> dict[str, Any]:
        """What `write` puts into a file; `from_dict` takes it."""
        cameras = {side: _camera_to_dict(getattr(self, side)) for side in ("left", "right")}
        pose = {"rotation": list(self.rotation), "translation": list(self.translation)}
        return {"format": _FORMAT, "version": _VERSION, "unit": "metre", **cameras, **pose}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Rig":
        """A rig from what `to_dict` gives. Entries that it does not know are passed over.

        Raises:
            InputError: another format, a version from the future, or missing or malformed entries.
        """
        check_version(values, _FORMAT, _VERSION)
        left, right = (_camera_from_dict(values.get(side), side) for side in ("left", "right"))
        rotation = numbers("the rig", "rotation", _listed(values.get("rotation")), 9)
        translation = numbers("the rig", "translation", _listed(values.get("translation")), 3)
        return cls(left, right, tuple(rotation), tuple(translation))

    def write(self, path: PathLike, *, about: Mapping[str, Any] | None = None, overwrite: bool = False) -> None:
        """Writes the rig as the library's own JSON.

        Args:
            path: ends in .json.
            about: what else is worth keeping: the board, errors, where it came from. Readers pass it over.
            overwrite: replace an existing file.

        Raises:
            InputError: another suffix, an existing file, or one that can't be written.
        """
        if Path(path).suffix.lower() != ".json":
            raise InputError(f"{os.fspath(path)!r}: a rig is written as .json")
        values = {**self.to_dict(), **({} if about is None else {"about": dict(about)})}
        write_json(path, values, overwrite=overwrite)


def is_rig(path: PathLike) -> bool:
    """Whether a file says that it is a rig, which `read_rig` reads; others may be calibrations of rectified pairs.

    Raises:
        InputError: a file that can't be read.
    """
    text = read_text(path)
    return f'"{_FORMAT}"' in text or "T_cn_cnm1" in keyed_lines(text, ":")


def read_rig(path: PathLike) -> Rig:
    """Reads a rig: the library's own JSON, or a Kalibr camchain of two cameras, of which cam0 is the left one.

    Raises:
        InputError: a missing or malformed file, or cameras that make no rig.

    Source: https://github.com/ethz-asl/kalibr/wiki/yaml-formats.
    """
    document = read_document(path)
    if document.get("format") == _FORMAT:
        with named(path):
            return Rig.from_dict(document)
    if {"cam0", "cam1"} <= document.keys():
        left, right, pose = read_kalibr(path, document)
        with named(path):
            return Rig(
                _from_kalibr(left),
                _from_kalibr(right),
                tuple(float(value) for value in pose[:3, :3].ravel()),
                tuple(float(value) for value in pose[:3, 3]),
            )
    raise InputError(f"{os.fspath(path)!r} is no rig; expected the library's own JSON, or Kalibr's cam0 and cam1")


def _from_kalibr(camera: KalibrCamera) -> Camera:
    width, height = map(int, camera.resolution)
    fx, fy, cx, cy = camera.intrinsics
    return Camera(fx, fy, cx, cy, width, height, tuple(camera.distortion), camera.model)


def _camera_to_dict(camera: Camera) -> dict[str, Any]:
    values = {key: getattr(camera, key) for key in ("model", "fx", "fy", "cx", "cy")}
    return {**values, "distortion": list(camera.distortion), "image_size": [camera.width, camera.height]}


def _camera_from_dict(values: Any, side: str) -> Camera:
    if not isinstance(values, dict):
        raise InputError(f"the rig has no camera {side!r}")
    keys = ("fx", "fy", "cx", "cy")
    fx, fy, cx, cy = numbers("the rig", f"{', '.join(keys)} of {side}", [values.get(key) for key in keys], 4)
    width, height = numbers("the rig", f"image_size of {side}", _listed(values.get("image_size")), 2)
    distortion = _listed(values.get("distortion"))
    coefficients = numbers("the rig", f"distortion of {side}", distortion, len(distortion))
    model = values.get("model", "pinhole")
    return Camera(fx, fy, cx, cy, int(width), int(height), tuple(coefficients), model)


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _text(values: tuple[float, ...]) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values)})"
