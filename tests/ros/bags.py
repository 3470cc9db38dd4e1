"""Small bags."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from stereokit.calibration import Calibration

STORE = get_typestore(Stores.ROS2_HUMBLE)


def make(kind: str, /, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def header(nanoseconds: int) -> Any:
    stamp = make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id="left_optical")


def image(rgb: npt.NDArray[np.uint8], nanoseconds: int) -> Any:
    height, width = rgb.shape[:2]
    return make(
        "sensor_msgs/msg/Image", header=header(nanoseconds), height=height, width=width, encoding="rgb8",
        is_bigendian=0, step=3 * width, data=rgb.reshape(-1),
    )  # fmt: skip


def camera_info(camera: Calibration, side: str) -> Any:
    cx = camera.cx0 if side == "left" else camera.cx1
    shift = 0.0 if side == "left" else -camera.fx * camera.baseline
    p = [camera.fx, 0, cx, shift, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0]
    roi = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return make(
        "sensor_msgs/msg/CameraInfo", header=header(0), height=camera.height, width=camera.width,
        distortion_model="plumb_bob", d=np.zeros(5), k=np.zeros(9), r=np.eye(3).reshape(-1),
        p=np.array(p, np.float64), binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip


def write_bag(path: Path, camera: Calibration, images: list[tuple[str, int, npt.NDArray[np.uint8]]]) -> Path:
    """A ROS 2 bag of images of "left" and "right" with their stamps in nanoseconds, and of camera_info."""
    with Writer(path, version=8) as bag:
        topics = {}
        for side in ("left", "right"):
            for name, kind in (("image_rect", "Image"), ("camera_info", "CameraInfo")):
                kind = f"sensor_msgs/msg/{kind}"
                topics[side, name] = bag.add_connection(f"/{side}/{name}", kind, typestore=STORE), kind
        messages = [(side, "camera_info", 0, camera_info(camera, side)) for side in ("left", "right")]
        messages += [(side, "image_rect", time, image(rgb, time)) for side, time, rgb in images]
        for side, name, time, message in messages:
            connection, kind = topics[side, name]
            bag.write(connection, time, STORE.serialize_cdr(message, kind))
    return path
