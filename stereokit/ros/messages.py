"""The fields of stereo_msgs/DisparityImage and sensor_msgs/PointCloud2."""

from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt

from stereokit.calibration import Calibration
from stereokit.cameras.cloud import PointCloud

__all__ = ["CloudFields", "DisparityFields", "cloud_fields", "disparity_fields"]

UNKNOWN = -1.0
"""What stands in a DisparityImage for unknown: it lies below its min_disparity of 0."""

_FLOAT32 = 7  # sensor_msgs/PointField


class DisparityFields(TypedDict):
    """Of a stereo_msgs/DisparityImage; `values` are those of its image, of encoding 32FC1."""

    values: npt.NDArray[np.float32]
    f: float
    t: float
    min_disparity: float
    max_disparity: float
    delta_d: float


class CloudFields(TypedDict):
    """Of a sensor_msgs/PointCloud2; `fields` are name, offset, datatype and count of each."""

    height: int
    width: int
    fields: list[tuple[str, int, int, int]]
    is_bigendian: bool
    point_step: int
    row_step: int
    data: npt.NDArray[np.uint8]
    is_dense: bool


def disparity_fields(disparity: npt.NDArray[Any], calibration: Calibration) -> DisparityFields:
    """What a stereo_msgs/DisparityImage holds, for which depth is Z = f T / d.

    So the offset of the principal points is taken out here, once: d = x_left - x_right + cx1 - cx0. Unknown pixels, and
    those behind the camera, are -1, below `min_disparity`.

    Args:
        disparity: (H, W) in pixels, x_left - x_right, NaN where unknown.
        calibration: of images of this size.

    Raises:
        InputError: a calibration of another size.

    Source: `stereo_msgs/DisparityImage.msg`; `stereo_image_proc` of image_pipeline subtracts the same offset.

    >>> found = disparity_fields(np.array([[10.0, np.nan]]), Calibration(fx=700.0, baseline=0.5, cx0=320.0, cx1=325.0))
    >>> found["values"].tolist(), found["f"] * found["t"] / 15
    ([[15.0, -1.0]], 23.333333333333332)
    """
    calibration.check_size(*disparity.shape)
    values = np.asarray(disparity, np.float32) + np.float32(calibration.doffs)
    known = np.isfinite(values) & (values > 0)
    return {
        "values": np.where(known, values, UNKNOWN).astype(np.float32),
        "f": calibration.fx,
        "t": calibration.baseline,
        "min_disparity": 0.0,
        "max_disparity": float(values[known].max()) if known.any() else 0.0,
        # networks find any fraction of a pixel
        "delta_d": 0.0,
    }


def cloud_fields(cloud: PointCloud) -> CloudFields:
    """What a sensor_msgs/PointCloud2 holds: x, y, z, rgb (packed, as rviz takes it), and confidence where it is known.

    The points are in the optical frame of the left camera if the cloud's axes are "opencv".

    >>> points, colors = np.array([[1, 2, 3]], np.float32), np.array([[255, 128, 0]], np.uint8)
    >>> found = cloud_fields(PointCloud(points, colors, np.zeros(1, np.intp)))
    >>> found["width"], found["point_step"], hex(found["data"].view("<u4")[3])
    (1, 16, '0xff8000')
    """
    names = ["x", "y", "z", "rgb", *(["confidence"] if cloud.confidence is not None else [])]
    table = np.empty((len(cloud), len(names)), "<f4")
    table[:, :3] = cloud.points
    red, green, blue = cloud.colors.astype(np.uint32).T
    table.view("<u4")[:, 3] = red << 16 | green << 8 | blue
    if cloud.confidence is not None:
        table[:, 4] = cloud.confidence
    step = 4 * len(names)
    return {
        "height": 1,
        "width": len(cloud),
        "fields": [(name, 4 * place, _FLOAT32, 1) for place, name in enumerate(names)],
        "is_bigendian": False,
        "point_step": step,
        "row_step": step * len(cloud),
        "data": table.reshape(-1).view(np.uint8),
        "is_dense": True,
    }
