"""sensor_msgs/CameraInfo of both cameras to a calibration."""

from typing import Any

import numpy as np

from stereokit.calibration import Calibration
from stereokit.calibration.formats.text import rectified
from stereokit.errors import InputError

__all__ = ["calibration_of"]


def calibration_of(left: Any, right: Any) -> Calibration:
    """The calibration of rectified images from the camera_info of both cameras.

    Their projection matrices say all: P[3] of the right one is -fx baseline.

    Args:
        left: of the left camera, with `p` (`P` in ROS 1), `width` and `height`.
        right: likewise.

    Raises:
        InputError: cameras that are not calibrated or not rectified, or that are swapped.

    Source: the documentation of `sensor_msgs/CameraInfo`.
    """
    first, second = (
        np.asarray(info.p if hasattr(info, "p") else info.P, np.float64).tolist() for info in (left, right)
    )
    if not (first[0] > 0 and second[0] > 0):
        raise InputError("camera_info: the projection matrix P is empty, so the cameras are not calibrated")
    for side, info in (("left", left), ("right", right)):
        if info.binning_x > 1 or info.binning_y > 1 or info.roi.width or info.roi.height:
            raise InputError(f"camera_info of the {side} camera: binning and a region of interest are not supported")
    size = (left.width, left.height) if left.width and left.height else None
    return rectified("camera_info", first, second, size=size, metres_per_unit=1.0)
