"""Disparity as a video in colours that do not flicker."""

import os
from types import TracebackType

import numpy as np
import numpy.typing as npt

from stereokit.errors import InputError, printable
from stereokit.pictures.colors import Picture, checked_range, robust_range
from stereokit.pictures.scale import picture_with_scale
from stereokit.video.writing import VideoWriter

__all__ = ["ColorVideoWriter", "RunningRange"]

# of VP9: fast, and with no visible loss
_VP9 = {"deadline": "realtime", "cpu-used": "8", "row-mt": "1", "crf": "20", "b": "0"}


class RunningRange:
    """The range of the colours of a clip, from frame to frame: it widens fast and narrows slowly.

    Each end moves towards that of `robust_range` by a share of what is missing, so that the same disparity keeps its
    colour while things come and go.

    Args:
        widen: the share where the frame's range reaches farther.
        narrow: the share where it does not.

    >>> running = RunningRange(widen=0.5, narrow=0.1)
    >>> [running.of(np.linspace(0, top, 1001).reshape(7, 143))[1] for top in (100, 200, 100)]
    [99.0, 148.5, 143.55]
    """

    def __init__(self, widen: float = 0.5, narrow: float = 0.02) -> None:
        self.widen, self.narrow = widen, narrow
        self._range: tuple[float, float] | None = None

    def of(self, disparity: npt.NDArray[np.floating]) -> tuple[float, float]:
        """The range for this frame, (H, W) in pixels. A frame without a known pixel leaves it as it is."""
        if not np.isfinite(disparity).any():
            return self._range or (0.0, 1.0)
        lo, hi = robust_range(disparity)
        if self._range is None:
            self._range = lo, hi
            return lo, hi
        low, high = self._range
        low += (self.widen if lo < low else self.narrow) * (lo - low)
        high += (self.widen if hi > high else self.narrow) * (hi - high)
        self._range = low, high
        return self._range


class ColorVideoWriter:
    """Writes disparity in colours above its scale, as VP9 in WebM, which browsers play.

    Args:
        path: ends in .webm.
        value_range: of the colours in all frames; by default a `RunningRange`.
        rate: frames per second, see `VideoWriter`.
        overwrite: replace an existing file.

    Raises:
        InputError: another suffix, a range without lo < hi, or a file that exists or can't be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        value_range: tuple[float, float] | None = None,
        rate: float | None = None,
        overwrite: bool = False,
    ) -> None:
        if not os.fspath(path).lower().endswith(".webm"):
            raise InputError(f"{printable(path)}: colours are written as a video in a file that ends in .webm")
        self._fixed = None if value_range is None else checked_range(value_range)
        self._running = RunningRange()
        self._canvas: tuple[int, ...] | None = None
        self._video = VideoWriter(
            path, codec="libvpx-vp9", pixels="yuv420p", options=_VP9, tags={}, rate=rate, overwrite=overwrite
        )
        self.path = self._video.path

    def write(self, disparity: npt.NDArray[np.floating], time: float) -> None:
        """Adds a frame.

        Args:
            disparity: (H, W) in pixels, NaN where unknown.
            time: in seconds.

        Raises:
            InputError: a map of another size, or a full disk.
        """
        picture = picture_with_scale(disparity, value_range=self._fixed or self._running.of(disparity))
        self._canvas = self._canvas or picture.shape
        self._video.write(_on_canvas(picture, self._canvas), "rgb24", time)

    def close(self) -> None:
        """Finishes the file; see `VideoWriter`."""
        self._video.close()

    def __enter__(self) -> "ColorVideoWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def _on_canvas(picture: Picture, shape: tuple[int, ...]) -> Picture:
    """A picture of this shape: the scale of a narrow map grows and shrinks with its numbers, beside white."""
    if picture.shape == shape or picture.shape[0] != shape[0]:
        return picture
    canvas = np.full(shape, 255, np.uint8)
    kept = min(shape[1], picture.shape[1])
    skipped, left = (picture.shape[1] - kept) // 2, (shape[1] - kept) // 2
    canvas[:, left : left + kept] = picture[:, skipped : skipped + kept]
    return canvas
