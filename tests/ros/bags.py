"""Small bags."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from stereokit.calibration import Calibration

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE1 = get_typestore(Stores.ROS1_NOETIC)


def make(kind: str, /, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def make1(kind: str, /, **fields: Any) -> Any:
    """A message of ROS 1, whose headers have a number and whose matrices have names in capitals."""
    if kind == "std_msgs/msg/Header":
        fields["seq"] = 0
    if kind == "sensor_msgs/msg/CameraInfo":
        fields = {name.upper() if name in ("d", "k", "r", "p") else name: value for name, value in fields.items()}
    return STORE1.types[kind](**fields)


def header(nanoseconds: int, make: Callable[..., Any] = make) -> Any:
    stamp = make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id="left_optical")


def image(rgb: npt.NDArray[np.uint8], nanoseconds: int, make: Callable[..., Any] = make) -> Any:
    height, width = rgb.shape[:2]
    return make(
        "sensor_msgs/msg/Image", header=header(nanoseconds, make), height=height, width=width, encoding="rgb8",
        is_bigendian=0, step=3 * width, data=rgb.reshape(-1),
    )  # fmt: skip


def camera_info(camera: Calibration, side: str, make: Callable[..., Any] = make) -> Any:
    cx = camera.cx0 if side == "left" else camera.cx1
    shift = 0.0 if side == "left" else -camera.fx * camera.baseline
    p = [camera.fx, 0, cx, shift, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0]
    roi = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return make(
        "sensor_msgs/msg/CameraInfo", header=header(0, make), height=camera.height, width=camera.width,
        distortion_model="plumb_bob", d=np.zeros(5), k=np.zeros(9), r=np.eye(3).reshape(-1),
        p=np.array(p, np.float64), binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip


def write_bag(path: Path, camera: Calibration, images: list[tuple[str, int, npt.NDArray[np.uint8]]]) -> Path:
    """A bag of images of "left" and "right" with their stamps in nanoseconds, and of camera_info: of ROS 1 where the
    path ends in .bag, else of ROS 2."""
    first = path.suffix == ".bag"
    store, build = (STORE1, make1) if first else (STORE, make)
    with Writer1(path) if first else Writer(path, version=8) as bag:
        topics = {}
        for side in ("left", "right"):
            for name, kind in (("image_rect", "Image"), ("camera_info", "CameraInfo")):
                kind = f"sensor_msgs/msg/{kind}"
                topics[side, name] = bag.add_connection(f"/{side}/{name}", kind, typestore=store), kind
        messages = [(side, "camera_info", 0, camera_info(camera, side, build)) for side in ("left", "right")]
        messages += [(side, "image_rect", time, image(rgb, time, build)) for side, time, rgb in images]
        for side, name, time, message in messages:
            connection, kind = topics[side, name]
            data = store.serialize_ros1(message, kind) if first else store.serialize_cdr(message, kind)
            bag.write(connection, time, data)
    return path
