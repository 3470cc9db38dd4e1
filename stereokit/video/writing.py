"""Video files that appear whole or not at all."""

import os
from contextlib import ExitStack, suppress
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy.typing as npt

from stereokit.errors import InputError, printable
from stereokit.files import atomic_path
from stereokit.runtime.optional import import_optional

__all__ = ["FFV1", "VideoWriter"]

FFV1 = {"level": "3", "slicecrc": "1"}
"""Options of the lossless encoder: with check sums, so that damage shows."""

_MILLISECOND = Fraction(1, 1000)


class VideoWriter:
    """Writes frames to a temporary file, which becomes `path` on `close`.

    As a context manager it closes at the end of the block, after an error too: the frames written are kept and whole. A
    file of no frame is not made.

    Args:
        path: the file; its suffix says the container.
        codec: FFmpeg's name of the encoder.
        pixels: FFmpeg's name of the encoded pixels.
        options: of the encoder.
        tags: what the file says of itself.
        rate: frames per second, which players show; by default what the times of the frames make it.
        overwrite: replace an existing file.

    Raises:
        InputError: the file exists already, or can't be written.
        ConfigError: PyAV is not installed.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        codec: str,
        pixels: str,
        options: dict[str, str],
        tags: dict[str, str],
        rate: float | None = None,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        self.frames = 0
        self._av = import_optional("av", "writing a video")
        self._codec, self._pixels, self._options = codec, pixels, options
        self._rate = Fraction(0 if rate is None else rate).limit_denominator(1001)
        self._size: tuple[int, int] | None = None
        self._last = -1
        self._file = ExitStack()
        self._temporary = self._file.enter_context(atomic_path(path, overwrite=overwrite))
        try:
            self._container = self._av.open(str(self._temporary), "w")
        except self._av.error.FFmpegError as error:
            self._discard()
            raise InputError(f"{printable(path)} can't be written: {error.strerror or error}") from error
        self._container.metadata.update(tags)

    def write(self, image: npt.NDArray[Any], given: str, time: float) -> None:
        """Adds a frame.

        Args:
            image: (H, W) or (H, W, 3), of one size in all frames.
            given: FFmpeg's name of its pixels, such as "rgb24".
            time: in seconds. Frames lie at least a millisecond apart.

        Raises:
            InputError: an image of another size, or a full disk.
        """
        height, width = image.shape[:2]
        if self._size is None:
            self._size = (height, width)
            self._track = self._container.add_stream(self._codec, options=self._options)
            self._track.height, self._track.width, self._track.pix_fmt = height, width, self._pixels
            # without one PyAV says 24
            self._track.codec_context.framerate = self._rate
            self._track.codec_context.time_base = self._track.time_base = _MILLISECOND
        if self._size != (height, width):
            raise InputError(
                f"{printable(self.path)} holds frames of {self._size[1]} x {self._size[0]} pixels, got one of "
                f"{width} x {height}"
            )
        frame = self._av.VideoFrame.from_ndarray(image, format=given)
        self._last = max(self._last + 1, round(time * 1000))
        frame.pts, frame.time_base = self._last, _MILLISECOND
        self._encode(frame)
        self.frames += 1

    def close(self) -> None:
        """Finishes the file; without any frame there is none.

        Raises:
            InputError: it can't be written.
        """
        if not self.frames:
            self._discard()
            return
        if not self._container:
            return
        self._encode(None)
        container, self._container = self._container, None
        try:
            container.close()
        except self._av.error.FFmpegError as error:
            self._discard()
            raise self._refusal(error) from error
        self._file.close()

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _encode(self, frame: Any) -> None:
        try:
            self._container.mux(self._track.encode(frame))
        except self._av.error.FFmpegError as error:
            self.frames = 0
            self._discard()
            raise self._refusal(error) from error

    def _refusal(self, error: Any) -> InputError:
        return InputError(f"{printable(self.path)} can't be written: {error.strerror or error}")

    def _discard(self) -> None:
        with suppress(_NothingToKeep, AttributeError, self._av.error.FFmpegError):
            self._container.close()
        with suppress(_NothingToKeep):
            self._file.__exit__(_NothingToKeep, _NothingToKeep(), None)


class _NothingToKeep(Exception):
    """Makes `atomic_path` remove its temporary file."""
