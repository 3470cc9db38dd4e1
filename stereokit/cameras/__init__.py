"""Cameras: calibration and its files. What works on images and disparity stands in the modules beside:

`depth` (metres out of disparity), `cloud` (points in space), `consistency` (left-right check), `checking` (whether a
pair can be matched). They use `stereokit.data`, which uses `Calibration`; so they are not imported here.
"""

from stereokit.cameras.calibration import Calibration
from stereokit.cameras.files import read_calibration, write_calibration

__all__ = ["Calibration", "read_calibration", "write_calibration"]
