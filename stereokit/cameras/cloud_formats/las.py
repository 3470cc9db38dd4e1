"""LAS 1.4 of the ASPRS, through laspy (the extra `las`)."""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from stereokit.runtime.optional import import_optional

__all__ = ["write_las"]

_STEP = 1e-4  # metres; coordinates are whole numbers of it, in 32 bits
_MOST_STEPS = 2e9
_POINT_FORMAT = 7  # with RGB


def write_las(
    path: Path,
    points: npt.NDArray[np.float32],
    colors: npt.NDArray[np.uint8],
    confidence: npt.NDArray[np.float32] | None,
    comment: str,
) -> None:
    """Writes coordinates, colours of 16 bits, and confidence as an extra dimension.

    Coordinates are rounded to 0.1 mm, more coarsely in clouds of over 200 km.

    Raises:
        ConfigError: laspy is not installed.

    Source: ASPRS, LAS Specification 1.4 - R15.
    """
    laspy = import_optional("laspy", "a point cloud as .las, unlike .ply and .pcd,")
    header = laspy.LasHeader(version="1.4", point_format=_POINT_FORMAT)
    exact = points.astype(np.float64) if len(points) else np.zeros((1, 3))
    header.scales = np.maximum(_STEP, np.ptp(exact, axis=0) / _MOST_STEPS)
    header.offsets = np.floor(exact.min(axis=0))
    header.generating_software = "stereokit"
    header.system_identifier = comment[:32]
    if confidence is not None:
        header.add_extra_dim(laspy.ExtraBytesParams("confidence", np.float32))
    file = laspy.LasData(header)
    file.x, file.y, file.z = np.moveaxis(points.astype(np.float64), 1, 0)
    file.red, file.green, file.blue = np.moveaxis(colors.astype(np.uint16) * 257, 1, 0)
    if confidence is not None:
        file.confidence = confidence
    file.write(str(path))
