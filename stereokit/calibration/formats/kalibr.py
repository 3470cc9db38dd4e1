"""Kalibr's camchain: two cameras that are not rectified."""

import os
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from stereokit.calibration.formats.text import numbers
from stereokit.calibration.rectified import PathLike
from stereokit.errors import InputError

__all__ = ["KalibrCamera", "read_kalibr"]

_MODELS: dict[str, Literal["pinhole", "fisheye"]] = {"radtan": "pinhole", "equidistant": "fisheye", "none": "pinhole"}


class KalibrCamera(NamedTuple):
    """One camera of a camchain: fx, fy, cx, cy; width and height; the lens in OpenCV's order."""

    intrinsics: list[float]
    resolution: list[float]
    distortion: list[float]
    model: Literal["pinhole", "fisheye"]


def read_kalibr(
    path: PathLike, document: Mapping[str, Any]
) -> tuple[KalibrCamera, KalibrCamera, npt.NDArray[np.float64]]:
    """Cameras cam0 and cam1 of a camchain, and the pose that maps points of cam0 to cam1, 4 x 4.

    Args:
        path: of the file, for errors.
        document: its content.

    Raises:
        InputError: something missing or malformed, or a model that OpenCV does not have.
    """
    cameras = [_camera(path, key, document[key]) for key in ("cam0", "cam1")]
    pose = document["cam1"].get("T_cn_cnm1")
    rows = pose if isinstance(pose, list) and len(pose) == 4 else []
    if not rows:
        raise InputError(f"{os.fspath(path)!r}: cam1 has no T_cn_cnm1 of 4 x 4 numbers")
    values = [numbers(path, "a row of T_cn_cnm1", row if isinstance(row, list | str) else [], 4) for row in rows]
    return cameras[0], cameras[1], np.array(values)


def _camera(path: PathLike, key: str, values: Any) -> KalibrCamera:
    name = os.fspath(path)
    if not isinstance(values, dict):
        raise InputError(f"{name!r}: {key} is no mapping; expected a Kalibr camchain")
    if values.get("camera_model") != "pinhole":
        raise InputError(
            f"{name!r}: {key} has the camera_model {str(values.get('camera_model'))[:40]!r}; use 'pinhole'"
        )
    kind = str(values.get("distortion_model"))
    if kind not in _MODELS:
        raise InputError(f"{name!r}: {key} has the distortion_model {kind[:40]!r}; use one of {', '.join(_MODELS)}")

    def listed(entry: str, count: int) -> list[float]:
        value = values.get(entry)
        return numbers(path, f"{entry} of {key}", value if isinstance(value, list) else [], count)

    distortion = [] if kind == "none" else listed("distortion_coeffs", 4)
    return KalibrCamera(listed("intrinsics", 4), listed("resolution", 2), distortion, _MODELS[kind])
