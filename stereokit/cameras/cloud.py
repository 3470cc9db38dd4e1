"""Points in space, out of disparity."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from stereokit.calibration.rectified import Calibration, PathLike
from stereokit.cameras.cloud_formats.las import write_las
from stereokit.cameras.cloud_formats.pcd import write_pcd
from stereokit.cameras.cloud_formats.ply import write_ply
from stereokit.cameras.depth import depth_from_disparity, fill_background
from stereokit.data.images import to_uint8
from stereokit.errors import InputError
from stereokit.files import atomic_path

__all__ = ["CLOUD_SUFFIXES", "Axes", "Holes", "PointCloud", "flying", "point_cloud"]

Axes: TypeAlias = Literal["opencv", "opengl", "ros"]
"""Directions of x, y and z: right, down, forward; right, up, backward; forward, left, up."""

Holes: TypeAlias = Literal["leave", "background"]

_AXES: dict[str, tuple[tuple[int, ...], tuple[int, ...]]] = {
    # which of the camera's axes, and its sign
    "opencv": ((0, 1, 2), (1, 1, 1)),
    "opengl": ((0, 1, 2), (1, -1, -1)),
    "ros": ((2, 0, 1), (1, -1, -1)),
}


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points in metres, seen from the rectified left camera.

    Attributes:
        points: (N, 3) float32.
        colors: (N, 3) uint8, RGB.
        pixels: (N,) the pixel of each point, row * width + column.
        confidence: (N,) float32 in [0, 1], or None.
        axes: of the points.
    """

    points: npt.NDArray[np.float32]
    colors: npt.NDArray[np.uint8]
    pixels: npt.NDArray[np.intp]
    confidence: npt.NDArray[np.float32] | None = None
    axes: Axes = "opencv"

    def __len__(self) -> int:
        return len(self.points)

    def write(self, path: PathLike, *, overwrite: bool = False) -> None:
        """Writes the cloud, in the format that the suffix names.

        Args:
            path: ends in .ply (binary), .pcd (binary), or .las, which needs the extra `las`.
            overwrite: replace an existing file.

        Raises:
            InputError: another suffix, or a file that can't be written.
            ConfigError: laspy is not installed.
        """
        suffix = Path(path).suffix.lower()
        if suffix not in _WRITERS:
            raise InputError(f"{os.fspath(path)!r}: point clouds are written as {', '.join(_WRITERS)}, not {suffix!r}")
        with atomic_path(path, overwrite=overwrite) as temporary:
            _WRITERS[suffix](temporary, self.points, self.colors, self.confidence, f"axes {self.axes}, metres")


def point_cloud(
    disparity: npt.ArrayLike,
    calibration: Calibration,
    image: npt.NDArray[Any],
    *,
    confidence: npt.NDArray[Any] | None = None,
    min_confidence: float | None = None,
    valid: npt.NDArray[np.bool_] | None = None,
    edge_filter: float | None = None,
    holes: Holes = "leave",
    max_depth: float | None = None,
    axes: Axes = "opencv",
) -> PointCloud:
    """The points that the left camera sees: X = (x - cx0) Z / fx, Y = (y - cy) Z / fy, Z of `depth_from_disparity`.

    Pixels are left out in this order: unknown ones, those outside of `valid`, those of low confidence, flying points;
    then holes are filled, if asked for; then those farther than `max_depth` are left out.

    Args:
        disparity: (H, W) in pixels, NaN where unknown.
        calibration: of images of this size, with cy.
        image: the left one, (H, W, 3), uint8 or floating-point in [0, 1].
        confidence: (H, W) in [0, 1]; it goes along with the points.
        min_confidence: pixels below it are left out.
        valid: (H, W), False where pixels are to be left out.
        edge_filter: leave out flying points, which lie on a ramp between two surfaces: pixels to which disparity rises
            or falls by more than so many pixels from both sides, see `flying`. 1 is a good value.
        holes: "leave" them, or fill them with the "background", see `fill_background`.
        max_depth: in metres.
        axes: "opencv" (x right, y down, z forward), "opengl" (x right, y up, z backward) or "ros" (x forward, y left,
            z up).

    Raises:
        InputError: parts of different sizes, a calibration without cy, `min_confidence` without `confidence`, or values
            out of range.

    >>> camera = Calibration(fx=8.0, baseline=0.5, cx0=1.0, cx1=1.0, cy=0.0)
    >>> cloud = point_cloud([[1.0, 0.0, 2.0]], camera, np.zeros((1, 3, 3), np.uint8))
    >>> cloud.points.tolist(), cloud.pixels.tolist()
    ([[-0.5, 0.0, 4.0], [0.25, 0.0, 2.0]], [0, 2])
    """
    cy = calibration.known_cy()
    values = np.asarray(disparity)
    kept = _kept(values, image, confidence, min_confidence, valid)
    if holes not in get_args(Holes):
        raise InputError(f"holes is 'leave' or 'background', got {holes!r}")
    if axes not in _AXES:
        raise InputError(f"axes are 'opencv', 'opengl' or 'ros', got {axes!r}")
    # unknown where there is no depth, which needs d + cx1 - cx0 > 0
    kept &= np.isfinite(depth_from_disparity(values, calibration))
    if edge_filter is not None:
        kept &= ~flying(np.where(kept, values, np.nan), threshold=edge_filter)
    values = np.where(kept, values, np.nan)
    if holes == "background":
        values = fill_background(values)
    depth = depth_from_disparity(values, calibration, max_depth=max_depth).astype(np.float64)
    rows, columns = np.nonzero(np.isfinite(depth))
    z = depth[rows, columns]
    seen = np.stack([(columns - calibration.cx0) * z / calibration.fx, (rows - cy) * z / calibration.fy, z], axis=1)
    order, signs = _AXES[axes]
    return PointCloud(
        points=(seen[:, order] * signs).astype(np.float32),
        colors=to_uint8(image[rows, columns]),
        pixels=rows * values.shape[1] + columns,
        confidence=None if confidence is None else confidence[rows, columns].astype(np.float32),
        axes=axes,
    )


def flying(disparity: npt.ArrayLike, *, threshold: float = 1.0) -> npt.NDArray[np.bool_]:
    """Pixels that lie between two surfaces, on neither.

    Along the row or the column, disparity goes on rising, or falling, by more than `threshold` to the pixel and from
    it. A clean step is kept on both of its sides, and a slanted surface at less than `threshold` for each pixel.

    Args:
        disparity: (H, W) in pixels, NaN where unknown. A pixel beside an unknown one is not judged in that direction.
        threshold: in pixels.

    Raises:
        InputError: a negative threshold.

    >>> flying([[3.0, 3.0, 3.0, 9.0, 9.0], [3.0, 3.0, 6.0, 9.0, 9.0]]).astype(int).tolist()
    [[0, 0, 0, 0, 0], [0, 0, 1, 0, 0]]
    """
    if not threshold >= 0:
        raise InputError(f"the threshold of the edge filter must be at least 0 px, got {threshold}")
    values = np.asarray(disparity, np.float64)
    result = np.zeros(values.shape, np.bool_)
    for axis in (0, 1):
        steps = np.moveaxis(np.diff(values, axis=axis), axis, 0)
        # NaN compares as False
        ramp = ((steps[:-1] > threshold) & (steps[1:] > threshold)) | (
            (steps[:-1] < -threshold) & (steps[1:] < -threshold)
        )
        np.moveaxis(result, axis, 0)[1:-1] |= ramp
    return result


def _kept(
    disparity: npt.NDArray[Any],
    image: npt.NDArray[Any],
    confidence: npt.NDArray[Any] | None,
    min_confidence: float | None,
    valid: npt.NDArray[np.bool_] | None,
) -> npt.NDArray[np.bool_]:
    """The pixels that pass the masks."""
    if image.ndim != 3 or image.shape[2] != 3:
        raise InputError(f"the image has shape {image.shape}; expected RGB (H, W, 3)")
    for name, values in (("image", image), ("confidence", confidence), ("valid mask", valid)):
        if values is not None and values.shape[:2] != disparity.shape:
            raise InputError(f"the {name} has shape {values.shape}, the disparity {disparity.shape}; expected one size")
    kept = np.ones(disparity.shape, np.bool_) if valid is None else valid.astype(np.bool_)
    if min_confidence is not None:
        if confidence is None:
            raise InputError("min_confidence needs the confidence, which was not given")
        if not 0 <= min_confidence <= 1:
            raise InputError(f"min_confidence lies from 0 to 1, got {min_confidence}")
        kept &= confidence >= min_confidence
    return kept


_WRITERS: dict[str, Callable[..., None]] = {".ply": write_ply, ".pcd": write_pcd, ".las": write_las}

CLOUD_SUFFIXES = tuple(_WRITERS)
"""Of the files that `PointCloud.write` makes."""
