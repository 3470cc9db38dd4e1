"""One or two cameras of this machine, through OpenCV."""

import time
from collections.abc import Iterator, Sequence
from typing import Any

import cv2

from stereokit.errors import InputError
from stereokit.video.frames import Picture, Shot

__all__ = ["Cameras"]


class Cameras:
    """Cameras that are read together: all are told to keep their picture, then the pictures are fetched.

    Args:
        devices: a number or a device for each.
        size: width and height to ask for; the camera's own by default.
        rate: frames per second to ask for.

    Raises:
        InputError: a camera is not there, or in use.
    """

    damaged = 0
    counted = False
    length: int | None = None

    def __init__(
        self, devices: Sequence[str], *, size: tuple[int, int] | None = None, rate: float | None = None
    ) -> None:
        self.name = " and ".join(f"camera:{device}" for device in devices)
        self.rate = rate
        self._size = size
        self._captures: list[Any] = []
        try:
            for device in devices:
                self._captures.append(_open(device))
        except InputError:
            self.close()
            raise
        for capture in self._captures:
            if size is not None:
                capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
                capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
            if rate is not None:
                capture.set(cv2.CAP_PROP_FPS, rate)

    def __iter__(self) -> Iterator[Shot]:
        """Pictures of all cameras, without end.

        Raises:
            InputError: a camera gives no more, or another size than was asked for.
        """
        while True:
            times = []
            for capture in self._captures:
                if not capture.grab():
                    raise InputError(f"{self.name} gives no more frames; is it still plugged in, and in use elsewhere?")
                times.append(time.monotonic())
            yield tuple(Picture(self._fetch(c), moment) for c, moment in zip(self._captures, times, strict=True))

    def close(self) -> None:
        """Lets go of the cameras."""
        for capture in self._captures:
            capture.release()

    def _fetch(self, capture: Any) -> Any:
        known, image = capture.retrieve()
        if not known:
            raise InputError(f"{self.name} gave a frame that can't be decoded")
        height, width = image.shape[:2]
        if self._size not in (None, (width, height)):
            raise InputError(
                f"{self.name} gives {width} x {height} px and not {self._size[0]} x {self._size[1]}; "
                "ask for a size that it has"
            )
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _open(device: str) -> Any:
    # one line is enough, and it is ours
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        capture = cv2.VideoCapture(int(device) if device.isdigit() else device)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not capture.isOpened():
        raise InputError(f"there is no camera at camera:{device}, or another program uses it")
    return capture
