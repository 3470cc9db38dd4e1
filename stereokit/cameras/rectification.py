"""Views as two cameras side by side, without distortion, would have seen them."""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.calibration.rectified import Calibration
from stereokit.cameras.rig import Camera, Rig
from stereokit.errors import InputError

__all__ = ["Rectification", "rectify"]

_Maps = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]

_LEAST_VALID = 0.3
_FISHEYE_VIEW = 90.0  # degrees


@dataclass(frozen=True, eq=False)
class Rectification:
    """How the views of a rig become a rectified pair.

    Attributes:
        calibration: of the rectified pair.
        left_map: column and row in the left view of each rectified pixel, two (H, W).
        right_map: the same in the right view.
        left_valid: (H, W) bool, which rectified pixels the left camera saw.
        right_valid: the same of the right camera.
        left_rotation: from the axes of the left camera to those of the rectified pair, 3 x 3.
        right_rotation: the same from the right camera.
    """

    calibration: Calibration
    left_map: _Maps
    right_map: _Maps
    left_valid: npt.NDArray[np.bool_]
    right_valid: npt.NDArray[np.bool_]
    left_rotation: npt.NDArray[np.float64]
    right_rotation: npt.NDArray[np.float64]

    @property
    def valid(self) -> npt.NDArray[np.bool_]:
        """(H, W), the pixels that both cameras saw. Networks match black borders otherwise."""
        return self.left_valid & self.right_valid

    def __call__(self, left: npt.NDArray[Any], right: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """The rectified pair of two views, black where nothing was seen.

        Args:
            left: (H, W, 3) or (H, W), uint8, uint16 or floating-point.
            right: of the same size.

        Raises:
            InputError: views of another size than the rig's.
        """
        height, width = self.left_valid.shape
        for side, view in (("left", left), ("right", right)):
            if view.shape[:2] != (height, width):
                raise InputError(
                    f"the {side} view has {view.shape[1]} x {view.shape[0]} pixels; the rig is for {width} x {height}; "
                    "if the views were resized, use rig.scaled, or 'stereokit calibrate convert RIG NEW --scale-to'"
                )
        first, second = (
            cv2.remap(view, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(0, 0, 0, 0))
            for view, maps in ((left, self.left_map), (right, self.right_map))
        )
        return first, second

    def seen(self, disparity: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
        """(H, W), the pixels that the left camera saw, and whose match the right one saw.

        A match that lies beside the right view counts as its border does, as it does for pairs that come rectified.

        Args:
            disparity: (H, W) of the rectified pair.
        """
        width = disparity.shape[1]
        rows, columns = np.indices(disparity.shape)
        matches = np.clip(np.rint(columns - np.nan_to_num(disparity)), 0, width - 1).astype(np.intp)
        return self.left_valid & self.right_valid[rows, matches]


def rectify(rig: Rig, *, field_of_view: float | None = None, alpha: float = 0.0) -> Rectification:
    """Finds the rectification of a rig, of the size of its images, with cx0 = cx1.

    Args:
        rig: two cameras, both "pinhole" or both "fisheye".
        field_of_view: horizontal, in degrees, of the rectified views, with their centre in the middle. By default what
            `alpha` says for pinhole cameras, and 90 degrees for fisheye ones, whose whole view fits no plane.
        alpha: for pinhole cameras: 0 shows only pixels that were seen, 1 all that were seen, with black borders.

    Raises:
        InputError: two models of lens, values out of range, or a rectification of no use: less than 30 % of the pixels
            seen by both cameras, or a principal point outside of the view.

    Source: A. Fusiello et al., A compact algorithm for rectification of stereo pairs, 2000; OpenCV's `stereoRectify`.

    >>> camera = Camera(500.0, 500.0, 319.5, 239.5, 640, 480)
    >>> rig = Rig(camera, camera, (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0), (-0.1, 0.0, 0.0))
    >>> rectify(rig, alpha=0.0).calibration.baseline
    0.1
    """
    left, right = rig.left, rig.right
    if left.model != right.model:
        raise InputError(f"rectify: the left camera is {left.model!r}, the right one {right.model!r}; expected one")
    if not 0 <= alpha <= 1:
        raise InputError(f"rectify: alpha lies from 0 to 1, got {alpha}")
    if alpha and (field_of_view is not None or left.model == "fisheye"):
        raise InputError(f"rectify: alpha={alpha} has no effect on fisheye cameras, nor beside a field of view")
    if field_of_view is not None and not 1 <= field_of_view <= 170:
        raise InputError(f"rectify: the field of view lies from 1 to 170 degrees, got {field_of_view}")
    rotations, camera_matrix = _planes(rig, alpha)
    if field_of_view is not None or left.model == "fisheye":
        camera_matrix = _centred(left, _FISHEYE_VIEW if field_of_view is None else field_of_view)
    fx, cx, cy = camera_matrix[0, 0], camera_matrix[0, 2], camera_matrix[1, 2]
    if not (fx > 0 and 0 <= cx <= left.width - 1 and 0 <= cy <= left.height - 1):
        raise InputError(
            f"rectify: the rectified cameras would have a focal length of {fx:.0f} px and a principal point at "
            f"({cx:.0f}, "
            f"{cy:.0f}) of {left.width} x {left.height} pixels; give a field_of_view, and check the rig"
        )
    maps = [_maps(camera, turn, camera_matrix) for camera, turn in zip((left, right), rotations, strict=True)]
    valid = [_seen(camera, *pair) for camera, pair in zip((left, right), maps, strict=True)]
    share = float((valid[0] & valid[1]).mean())
    if share < _LEAST_VALID:
        raise InputError(
            f"rectify: both cameras see only {share:.0%} of the rectified view; expected at least "
            f"{_LEAST_VALID:.0%}, so "
            "check the rig, or give a smaller field_of_view"
        )
    calibration = Calibration(
        fx=float(fx),
        baseline=rig.baseline,
        cx0=float(cx),
        cx1=float(cx),
        width=left.width,
        height=left.height,
        fy=float(camera_matrix[1, 1]),
        cy=float(cy),
    )
    return Rectification(calibration, maps[0], maps[1], valid[0], valid[1], rotations[0], rotations[1])


def _planes(rig: Rig, alpha: float) -> tuple[list[npt.NDArray[np.float64]], npt.NDArray[np.float64]]:
    """The rotations of both cameras, and the camera matrix of the rectified pair."""
    left, right = rig.left, rig.right
    size = left.width, left.height
    rotation, translation = np.reshape(rig.rotation, (3, 3)), np.reshape(rig.translation, (3, 1))
    given = (left.matrix, left.coefficients, right.matrix, right.coefficients, size, rotation, translation)
    if left.model == "fisheye":
        first, second, projection, *_ = cv2.fisheye.stereoRectify(*given, flags=cv2.CALIB_ZERO_DISPARITY)
    else:
        first, second, projection, *_ = cv2.stereoRectify(*given, flags=cv2.CALIB_ZERO_DISPARITY, alpha=alpha)
    matrix = np.asarray(projection, np.float64)[:, :3]
    return [np.asarray(first, np.float64), np.asarray(second, np.float64)], matrix


def _centred(camera: Camera, field_of_view: float) -> npt.NDArray[np.float64]:
    focal = camera.width / 2 / math.tan(math.radians(field_of_view / 2))
    return np.array([[focal, 0, (camera.width - 1) / 2], [0, focal, (camera.height - 1) / 2], [0, 0, 1]])


def _maps(camera: Camera, rotation: npt.NDArray[np.float64], matrix: npt.NDArray[np.float64]) -> _Maps:
    module = cv2.fisheye if camera.model == "fisheye" else cv2
    size = camera.width, camera.height
    columns, rows = module.initUndistortRectifyMap(
        camera.matrix, camera.coefficients, rotation, matrix, size, cv2.CV_32FC1
    )
    return np.asarray(columns, np.float32), np.asarray(rows, np.float32)


def _seen(camera: Camera, columns: npt.NDArray[np.float32], rows: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    return (columns >= 0) & (columns <= camera.width - 1) & (rows >= 0) & (rows <= camera.height - 1)
