"""What a rectified pair of cameras is, and its files in every format."""

from stereokit.calibration.files import read_calibration, write_calibration
from stereokit.calibration.rectified import Calibration

__all__ = ["Calibration", "read_calibration", "write_calibration"]
