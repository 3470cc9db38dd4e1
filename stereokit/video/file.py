"""Every frame of a video file."""

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from stereokit.errors import InputError, printable
from stereokit.runtime.optional import import_optional
from stereokit.video.frames import Picture, Shot, decoded_image

__all__ = ["VideoFile"]


class VideoFile:
    """The frames of the first video track of a file, in order.

    The pixels are those stored: an orientation noted in the file is not applied, because it would turn a rectified
    pair.

    Args:
        path: any format that FFmpeg reads.

    Raises:
        InputError: the file is missing, or no video, or cut off at its start or before its index.
        ConfigError: PyAV is not installed.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        av = import_optional("av", "a video file")
        self.name = printable(path)
        self.damaged = 0
        self._error = av.error.FFmpegError
        self._short = _shorter_than_it_says(path)
        try:
            self._container = av.open(os.fspath(path))
        except (self._error, OSError) as error:
            raise InputError(
                f"{self.name} can't be read as a video: {error.strerror or error}; the file is damaged, cut off, or of "
                "another kind"
            ) from error
        if not self._container.streams.video:
            self.close()
            raise InputError(f"{self.name} has no video track")
        self._track = self._container.streams.video[0]
        self.rate = float(self._track.average_rate) if self._track.average_rate else None
        self._end = _declared_end(self._container, self._track)
        about = round(self._end * self.rate) if self._end and self.rate else None
        # that of other kinds than mp4 is seldom a count
        self.counted = "mp4" in self._container.format.name and self._track.frames > 0
        self.length: int | None = self._track.frames if self.counted else about
        self._whole = True
        self._seen = 0.0

    @property
    def tags(self) -> dict[str, str]:
        """What the file says of itself, names in lower case."""
        return {key.lower(): value for key, value in self._container.metadata.items()}

    def __iter__(self) -> Iterator[Shot]:
        """Every frame; of a file that was cut off those that are whole.

        Raises:
            InputError: after the last whole frame, if there should be more.
        """
        for given, frame in enumerate(self.decoded()):
            moment = given / (self.rate or 25) if frame.time is None else frame.time
            yield (Picture(decoded_image(frame), moment),)

    def decoded(self) -> Iterator[Any]:
        """The frames as PyAV gives them.

        Raises:
            InputError: see `__iter__`.
        """
        given = 0
        for frame in self._decode():
            if frame.is_corrupt:
                self._whole = False
                break
            yield frame
            given += 1
        late = 0.5 / (self.rate or 25)
        if not self._whole or (self._end is not None and self._seen < self._end - late):
            expected = f" of {self.length:,}" if self.length and self.length > given else ""
            raise InputError(
                f"{self.name} ends after {given:,}{expected} whole frames: the file was cut off or is damaged there"
            )

    def close(self) -> None:
        """Closes the file."""
        self._container.close()

    def _decode(self) -> Iterator[Any]:
        """Frames up to the end or the first packet that is not whole, which is noted."""
        try:
            for packet in self._packets():
                if packet is None or packet.is_corrupt:
                    self._whole = False
                    break
                if packet.pts is not None:
                    lasts = float(packet.duration * packet.time_base) if packet.duration else 1 / (self.rate or 25)
                    self._seen = max(self._seen, float(packet.pts * packet.time_base) + lasts)
                yield from packet.decode()
        except self._error:
            self._whole = False
        if not self._whole:
            # the decoder holds some back, which are whole
            with suppress(self._error):
                yield from self._track.codec_context.decode(None)

    def _packets(self) -> Iterator[Any]:
        """The packets of the track; None instead of the last one, where the file was cut off within it."""
        held = None
        for packet in self._container.demux(self._track):
            if not self._short:
                yield packet
            elif packet.size:
                if held is not None:
                    yield held
                held = packet
        if self._short:
            yield None


def _declared_end(container: Any, track: Any) -> float | None:
    """When the track ends in seconds, by what the file's header says; None where it says nothing."""
    if "matroska" in container.format.name:
        hours, minutes, seconds = (float(part) for part in track.metadata.get("DURATION", "0:0:0").split(":"))
        return 3600 * hours + 60 * minutes + seconds or None
    if "mp4" in container.format.name and track.duration:
        return float(((track.start_time or 0) + track.duration) * track.time_base)
    # others have it estimated from the size of the file
    return None


def _shorter_than_it_says(path: str | os.PathLike[str]) -> bool:
    """Whether an AVI file has fewer bytes than its header says; FFmpeg does not look."""
    if not Path(path).is_file():
        return False
    with open(path, "rb") as file:
        start = file.read(8)
    return start[:4] == b"RIFF" and len(start) == 8 and int.from_bytes(start[4:], "little") + 8 > os.path.getsize(path)
