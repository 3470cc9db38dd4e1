"""A ROS 2 node: rectified images of both cameras in, stereo_msgs/DisparityImage and PointCloud2 out.

    python examples/ros2_node.py --ros-args -r left/image_rect:=/camera/left/image_rect ...

It subscribes to left/image_rect, right/image_rect, left/camera_info and right/camera_info, and publishes disparity and
points2. All arithmetic is in `disparity_and_cloud`, which needs no ROS.
"""

from typing import Any

import numpy as np

from stereokit import Predictor
from stereokit.ros import calibration_of, cloud_fields, disparity_fields, rgb_of


def disparity_and_cloud(predict: Any, messages: tuple[Any, Any, Any, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The fields of a DisparityImage and of a PointCloud2, from both images and both camera_info."""
    left, right = (rgb_of(message) for message in messages[:2])
    calibration = calibration_of(*messages[2:])
    result = predict(left, right)
    cloud = result.point_cloud(calibration, left, edge_filter=1.0)
    return dict(disparity_fields(result.disparity, calibration)), dict(cloud_fields(cloud))


def main() -> None:
    import message_filters
    import rclpy
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image, PointCloud2, PointField, RegionOfInterest
    from stereo_msgs.msg import DisparityImage

    class StereoNode(Node):
        def __init__(self) -> None:
            super().__init__("stereokit")
            self.predict = Predictor("coex")
            # one waits at most: a frame that comes while another is matched replaces it
            topics = (Image, "left/image_rect"), (Image, "right/image_rect")
            topics += (CameraInfo, "left/camera_info"), (CameraInfo, "right/camera_info")
            inputs = [
                message_filters.Subscriber(self, kind, topic, qos_profile=qos_profile_sensor_data)
                for kind, topic in topics
            ]
            self.together = message_filters.ApproximateTimeSynchronizer(inputs, queue_size=5, slop=0.005)
            self.together.registerCallback(self.match)
            self.disparities = self.create_publisher(DisparityImage, "disparity", 1)
            self.clouds = self.create_publisher(PointCloud2, "points2", 1)

        def match(self, *messages: Any) -> None:
            disparity, cloud = disparity_and_cloud(self.predict, messages)
            values = disparity.pop("values")
            height, width = values.shape
            header = messages[0].header
            image = Image(header=header, height=height, width=width, encoding="32FC1", step=4 * width)
            image.data = values.astype(np.float32).tobytes()
            window = RegionOfInterest(height=height, width=width)
            self.disparities.publish(DisparityImage(header=header, image=image, valid_window=window, **disparity))
            cloud["fields"] = [PointField(name=n, offset=o, datatype=k, count=c) for n, o, k, c in cloud["fields"]]
            cloud["data"] = cloud["data"].tobytes()
            self.clouds.publish(PointCloud2(header=header, **cloud))

    rclpy.init()
    rclpy.spin(StereoNode())


if __name__ == "__main__":
    main()
