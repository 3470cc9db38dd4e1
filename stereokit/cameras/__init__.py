"""From two cameras to metric depth: rigs, rectification, the check of a pair, depth and point clouds.

`stereokit.calibration` has the cameras of a rectified pair and their files. What needs more is imported from its own
module: `depth`, `cloud`, `consistency`, `checking`, `rig`, `rectification`, `boards`, `calibrating`.
"""

from stereokit.calibration import Calibration, read_calibration, write_calibration

__all__ = ["Calibration", "read_calibration", "write_calibration"]
