"""A bag of stereo images to a bag of disparity and point clouds."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from stereokit.calibration import Calibration
from stereokit.cameras.cloud import PointCloud
from stereokit.errors import InputError, printable
from stereokit.ros.camera_info import calibration_of
from stereokit.ros.images import rgb_of
from stereokit.ros.messages import cloud_fields, disparity_fields
from stereokit.ros.pairing import StampPairs
from stereokit.runtime.optional import import_optional

__all__ = ["BagPair", "BagWriter", "StereoBag", "Topics"]

PURPOSE = "a ROS bag"


@dataclass(frozen=True)
class Topics:
    """Those of a stereo camera, whose images are rectified.

    Attributes:
        left: images of the left view.
        right: of the right one.
        left_info: camera_info; by default beside the images, `/left/camera_info` for `/left/image_rect`.
        right_info: likewise.
    """

    left: str
    right: str
    left_info: str = ""
    right_info: str = ""

    def __post_init__(self) -> None:
        for side in ("left", "right"):
            if not getattr(self, f"{side}_info"):
                base = getattr(self, side).removesuffix("/compressed").rpartition("/")[0]
                object.__setattr__(self, f"{side}_info", f"{base}/camera_info")


@dataclass(frozen=True, eq=False)
class BagPair:
    """A pair of a bag.

    Attributes:
        left: (H, W, 3), uint8, RGB.
        right: likewise.
        calibration: of the pair.
        header: of the left message.
        time: when the bag received the left image, in nanoseconds.
    """

    left: npt.NDArray[np.uint8]
    right: npt.NDArray[np.uint8]
    calibration: Calibration
    header: Any
    time: int


class StereoBag:
    """The pairs of a bag of ROS 1 or ROS 2, by the stamps of their headers.

    Args:
        path: a .bag file, or the folder or file of a ROS 2 bag.
        topics: of the camera.
        tolerance: seconds by which the stamps of a pair may differ.

    Attributes:
        length: images of the left topic.
        unpaired: images of each side without a partner, once all were read.

    Raises:
        InputError: no bag, or topics that it does not hold.
        ConfigError: rosbags is not installed.
    """

    def __init__(self, path: str | os.PathLike[str], topics: Topics, tolerance: float = 0.005) -> None:
        highlevel = import_optional("rosbags.highlevel", PURPOSE)
        typesys = import_optional("rosbags.typesys", PURPOSE)
        self.name = printable(path)
        if not Path(path).exists():
            raise InputError(f"{self.name} does not exist")
        self._topics = topics
        self._pairs: StampPairs[tuple[Any, int]] = StampPairs(round(tolerance * 1e9))
        # of ROS 2 bags from before they held their types
        store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        try:
            self._reader = highlevel.AnyReader([Path(path)], default_typestore=store)
            self._reader.open()
        except Exception as error:
            raise InputError(f"{self.name} can't be read as a bag: {error}") from error
        counts = {name: info.msgcount for name, info in self._reader.topics.items()}
        wanted = (topics.left, topics.right, topics.left_info, topics.right_info)
        missing = [name for name in wanted if not counts.get(name)]
        if missing:
            self.close()
            raise InputError(f"{self.name} holds no messages of {missing[0]!r}; it holds {', '.join(sorted(counts))}")
        self.length = int(counts[topics.left])

    @property
    def unpaired(self) -> dict[str, int]:
        """Images without a partner so far, by side."""
        return self._pairs.unpaired

    def __iter__(self) -> Iterator[BagPair]:
        """The pairs, in the order of the bag.

        Raises:
            InputError: an image that can't be read, camera_info that is not of a rectified pair, or a damaged bag.
        """
        sides: dict[str, Literal["left", "right"]] = {self._topics.left: "left", self._topics.right: "right"}
        calibration = self._calibration()
        for topic, time, message in self._messages(list(sides)):
            stamp = message.header.stamp
            found = self._pairs.add(sides[topic], _nanoseconds(stamp), (message, time))
            if found is not None:
                (left, received), (right, _) = found
                yield BagPair(rgb_of(left), rgb_of(right), calibration, left.header, received)
        self._pairs.finish()

    def close(self) -> None:
        """Closes the bag."""
        self._reader.close()

    def __enter__(self) -> "StereoBag":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _calibration(self) -> Calibration:
        infos = (self._topics.left_info, self._topics.right_info)
        left, right = (next(message for _, _, message in self._messages([topic])) for topic in infos)
        return calibration_of(left, right)

    def _messages(self, topics: Sequence[str]) -> Iterator[tuple[str, int, Any]]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        messages = self._reader.messages(connections=connections)
        while True:
            try:
                connection, time, data = next(messages)
                message = self._reader.deserialize(data, connection.msgtype)
            except StopIteration:
                return
            except Exception as error:
                raise InputError(f"{self.name} is damaged: {error}") from error
            yield connection.topic, time, message


@dataclass
class BagWriter:
    """A new ROS 2 bag of stereo_msgs/DisparityImage and sensor_msgs/PointCloud2.

    It is written to a temporary folder that becomes `path` on `close`; a bag without messages is not made.

    Args:
        path: a folder that does not exist yet.
        disparity_topic: of the disparity.
        cloud_topic: of the point clouds.

    Raises:
        InputError: there is something at `path`, or it can't be written.
        ConfigError: rosbags is not installed.
    """

    path: str | os.PathLike[str]
    disparity_topic: str = "/disparity"
    cloud_topic: str = "/points2"
    messages: int = 0
    _connections: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rosbag2 = import_optional("rosbags.rosbag2", PURPOSE)
        typesys = import_optional("rosbags.typesys", PURPOSE)
        target = Path(self.path)
        if target.exists():
            raise InputError(f"{printable(self.path)} exists already; choose another name for the new bag")
        self._types = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        self._temporary = target.with_name(f".{target.name}.{os.getpid()}")
        try:
            self._writer = rosbag2.Writer(self._temporary, version=8)
            self._writer.open()
        except Exception as error:
            raise InputError(f"{printable(self.path)} can't be written: {error}") from error

    def add_disparity(self, disparity: npt.NDArray[np.float32], pair: BagPair) -> None:
        """Writes the disparity of a pair, see `disparity_fields`.

        Raises:
            InputError: camera_info of another size than the images.
        """
        fields = disparity_fields(disparity, pair.calibration)
        values = fields.pop("values")  # type: ignore[misc]
        height, width = values.shape
        header = self._header(pair.header)
        image = self._make(
            "sensor_msgs/msg/Image", header=header, height=height, width=width, encoding="32FC1", is_bigendian=0,
            step=4 * width, data=values.astype("<f4").reshape(-1).view(np.uint8),
        )  # fmt: skip
        window = self._make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=height, width=width, do_rectify=False
        )
        kind = "stereo_msgs/msg/DisparityImage"
        message = self._make(kind, header=header, image=image, valid_window=window, **fields)
        self._write(self.disparity_topic, kind, message, pair.time)

    def add_cloud(self, cloud: PointCloud, pair: BagPair) -> None:
        """Writes the points of a pair, see `cloud_fields`."""
        fields = cloud_fields(cloud)
        entries = [
            self._make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=kind, count=count)
            for name, offset, kind, count in fields["fields"]
        ]
        kind = "sensor_msgs/msg/PointCloud2"
        message = self._make(kind, header=self._header(pair.header), **{**fields, "fields": entries})
        self._write(self.cloud_topic, kind, message, pair.time)

    def close(self) -> None:
        """Finishes the bag."""
        with ExitStack() as stack:
            if not self.messages:
                stack.callback(_remove, self._temporary)
            self._writer.close()
        if self.messages:
            self._temporary.rename(self.path)

    def __enter__(self) -> "BagWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _header(self, header: Any) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", sec=header.stamp.sec, nanosec=header.stamp.nanosec)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=header.frame_id)

    def _make(self, kind: str, /, **fields: Any) -> Any:
        make: Callable[..., Any] = self._types.types[kind]
        return make(**fields)

    def _write(self, topic: str, kind: str, message: Any, time: int) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._types)
        self._writer.write(self._connections[topic], time, self._types.serialize_cdr(message, kind))
        self.messages += 1


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _remove(folder: Path) -> None:
    with suppress(OSError):
        for path in folder.iterdir():
            path.unlink()
        folder.rmdir()
