"""Small videos, and live sources that are not."""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from queue import Queue

import av
import numpy as np
import numpy.typing as npt

from stereokit.errors import InputError
from stereokit.video.frames import Picture, Shot

WIDTH, HEIGHT = 96, 64


def picture(number: int, width: int = WIDTH, height: int = HEIGHT) -> npt.NDArray[np.uint8]:
    """A picture of noise that tells its number."""
    return np.random.default_rng(number).integers(0, 255, (height, width, 3), np.uint8)


def write_video(
    path: Path, pictures: Sequence[npt.NDArray[np.uint8]], *, codec: str = "ffv1", rate: int = 10, **options: str
) -> Path:
    """A video of these pictures; FFV1 keeps them exactly."""
    with av.open(str(path), "w", options=options) as container:
        track = container.add_stream(codec, rate=rate)
        track.height, track.width = pictures[0].shape[:2]
        track.pix_fmt = "bgr0" if codec == "ffv1" else "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for number, rgb in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, rate)
            container.mux(track.encode(frame))
        container.mux(track.encode(None))
    return path


def cut(path: Path, share: float) -> Path:
    """The beginning of a file, as if the disk had been full."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path


class FakeCamera:
    """A live source that gives what the test puts in: images, None for its end, an error to raise."""

    def __init__(self, views: int = 1, damaged: int = 0) -> None:
        self.name, self.rate, self.length, self.counted, self.damaged = "camera:9", None, None, False, damaged
        self.views = views
        self.closed = False
        self._waiting: Queue[int | InputError | None] = Queue()

    def give(self, *numbers: "int | InputError | None") -> None:
        for number in numbers:
            self._waiting.put(number)

    def wait_until_read(self) -> None:
        """Until all that was given has been taken in and stands ready."""
        self._waiting.join()

    def __iter__(self) -> Iterator[Shot]:
        while True:
            number = self._waiting.get()
            if number is None:
                self._waiting.task_done()
                return
            if isinstance(number, InputError):
                self._waiting.task_done()
                raise number
            try:
                yield tuple(Picture(picture(number + 100 * view), number + 0.25 * view) for view in range(self.views))
            finally:
                # the reader is back for more, so it has stored this one
                self._waiting.task_done()

    def close(self) -> None:
        self.closed = True
