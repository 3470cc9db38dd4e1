"""ROS messages to images and calibration, and disparity to ROS messages; bags of both.

Messages are known by their fields alone, so those of ROS 2, of ROS 1 and of the package `rosbags` (the extra `ros`) all
do.
"""

from stereokit.ros.camera_info import calibration_of
from stereokit.ros.images import rgb_of
from stereokit.ros.messages import cloud_fields, disparity_fields
from stereokit.ros.pairing import StampPairs

__all__ = ["StampPairs", "calibration_of", "cloud_fields", "disparity_fields", "rgb_of"]
