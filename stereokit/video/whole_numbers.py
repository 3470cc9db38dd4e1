"""Disparity and depth as lossless videos of 16 bits."""

import math
import os
from collections.abc import Iterator
from types import TracebackType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from stereokit.data.disparity_png import KITTI_SCALE
from stereokit.errors import InputError, printable
from stereokit.video.file import VideoFile
from stereokit.video.writing import FFV1, VideoWriter

__all__ = ["DEPTH_SCALE", "MapVideoWriter", "TimedMap", "fitting_scale", "read_disparity_video", "read_map_video"]

DEPTH_SCALE = 1000.0
"""Of depth: millimetres."""

_MOST = 65535


class TimedMap(NamedTuple):
    """A frame of a map video: seconds, and (H, W) float32, NaN where unknown."""

    time: float
    values: npt.NDArray[np.float32]


class MapVideoWriter:
    """Writes maps as FFV1, 16 bits: value = max(1, round((map - lowest) scale)), 0 where unknown.

    FFV1 loses nothing; what is lost is below 1 / (2 scale). The file says scale and lowest value itself, in the tags
    `<kind>_scale` and `<kind>_lowest`. A value that 16 bits can't hold becomes unknown, and is counted.

    Args:
        path: ends in .mkv.
        kind: "disparity" in pixels, or "depth" in metres.
        scale: the stored value of one pixel, or one metre. 256, as in KITTI's PNG, holds disparity below 256 px.
        lowest: the least value that can be stored.
        rate: frames per second, see `VideoWriter`.
        overwrite: replace an existing file.

    Attributes:
        lost: known values that the file does not hold, because they lie outside of its range.

    Raises:
        InputError: another suffix, a scale that is not positive, or a file that exists or can't be written.

    Source: RFC 9043, FFV1 video coding format versions 0, 1 and 3.

    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "disparity.mkv"
    >>> with MapVideoWriter(path) as video:
    ...     for second in range(3):
    ...         video.write(np.full((40, 60), 12.5 + second), time=second)
    >>> [(found.time, float(found.values[0, 0])) for found in read_disparity_video(path)]
    [(0.0, 12.5), (1.0, 13.5), (2.0, 14.5)]
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        kind: str = "disparity",
        scale: float = KITTI_SCALE,
        lowest: float = 0.0,
        rate: float | None = None,
        overwrite: bool = False,
    ) -> None:
        if not os.fspath(path).lower().endswith(".mkv"):
            raise InputError(f"{printable(path)}: {kind} is written as a video in a file that ends in .mkv")
        if not (math.isfinite(scale) and scale > 0 and math.isfinite(lowest)):
            raise InputError(f"{printable(path)}: scale must be a positive number, got {scale} and lowest {lowest}")
        self.scale, self.lowest, self.lost = scale, lowest, 0
        tags = {f"{kind}_scale": repr(float(scale)), f"{kind}_lowest": repr(float(lowest))}
        self._video = VideoWriter(
            path, codec="ffv1", pixels="gray16le", options=FFV1, tags=tags, rate=rate, overwrite=overwrite
        )
        self.path = self._video.path

    def write(self, values: npt.NDArray[np.floating], time: float) -> None:
        """Adds a frame.

        Args:
            values: (H, W), NaN where unknown.
            time: in seconds.

        Raises:
            InputError: a map of another size, or a full disk.
        """
        stored = np.rint((values.astype(np.float64) - self.lowest) * self.scale)
        known = np.isfinite(stored)
        held = known & (stored >= 0) & (stored <= _MOST)
        self.lost += int(np.count_nonzero(known & ~held))
        samples = np.zeros(stored.shape, np.uint16)
        # 0 stands for unknown
        samples[held] = np.maximum(stored[held], 1)
        self._video.write(samples, "gray16le", time)

    def close(self) -> None:
        """Finishes the file; see `VideoWriter`."""
        self._video.close()

    def __enter__(self) -> "MapVideoWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def fitting_scale(largest: float) -> float:
    """KITTI's scale of 256, or its half, quarter ... that holds a disparity.

    >>> fitting_scale(191.0), fitting_scale(384.0)
    (256.0, 128.0)
    """
    return KITTI_SCALE / 2 ** max(0, math.ceil(math.log2(max(1.0, largest * KITTI_SCALE / _MOST))))


def read_disparity_video(path: str | os.PathLike[str]) -> Iterator[TimedMap]:
    """The frames of a video that `MapVideoWriter` wrote, in pixels of disparity.

    Raises:
        InputError: see `read_map_video`.
    """
    return read_map_video(path, "disparity")


def read_map_video(path: str | os.PathLike[str], kind: str) -> Iterator[TimedMap]:
    """The frames of a video that `MapVideoWriter` wrote.

    Args:
        path: the file.
        kind: "disparity" or "depth".

    Raises:
        InputError: a file that is no video of this kind, or was cut off, after its whole frames.
    """
    video = VideoFile(path)
    try:
        try:
            scale, lowest = (float(video.tags[f"{kind}_{name}"]) for name in ("scale", "lowest"))
        except (KeyError, ValueError) as error:
            raise InputError(
                f"{video.name} does not say the scale of its {kind}; expected a video that stereokit wrote"
            ) from error
        for frame in video.decoded():
            if frame.format.name != "gray16le":
                raise InputError(f"{video.name} holds {frame.format.name} pixels; expected 16-bit grey")
            samples = frame.to_ndarray(format="gray16le")
            values = (samples / scale + lowest).astype(np.float32)
            values[samples == 0] = np.nan
            yield TimedMap(frame.time, values)
    finally:
        video.close()
