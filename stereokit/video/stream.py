"""A stream of the network, such as rtsp://..., through PyAV."""

import time
from collections.abc import Iterator

from stereokit.errors import InputError
from stereokit.runtime.optional import import_optional
from stereokit.video.frames import Picture, Shot, decoded_image
from stereokit.video.places import Place

__all__ = ["Stream"]


class Stream:
    """The frames of a stream as they arrive. What did not arrive whole is left out and counted.

    Args:
        place: the address.
        timeout: seconds to wait for the connection, and for each packet.

    Raises:
        InputError: nobody answers, or what answers is no video.
        ConfigError: PyAV is not installed.
    """

    def __init__(self, place: Place, timeout: float) -> None:
        av = import_optional("av", "a stream")
        self.name = place.shown
        self.length: int | None = None
        self.counted = False
        self.damaged = 0
        self._error = av.error.FFmpegError
        # TCP: datagrams that are lost tear pictures apart
        options = {"rtsp_transport": "tcp", "fflags": "nobuffer"}
        try:
            self._container = av.open(place.where, options=options, timeout=(timeout, timeout))
        except (self._error, OSError) as error:
            # the error's own words hold the address, and so the password
            raise InputError(
                f"{self.name} can't be opened: {error.strerror or type(error).__name__}; is the camera on, and the "
                "address right?"
            ) from error
        if not self._container.streams.video:
            self.close()
            raise InputError(f"{self.name} has no video track")
        track = self._container.streams.video[0]
        self.rate = float(track.average_rate) if track.average_rate else None

    def __iter__(self) -> Iterator[Shot]:
        """Every frame, at the time of its arrival.

        Raises:
            InputError: the connection broke.
        """
        try:
            for packet in self._container.demux(video=0):
                try:
                    frames = packet.decode()
                except self._error:
                    self.damaged += 1
                    continue
                for frame in frames:
                    if frame.is_corrupt:
                        self.damaged += 1
                    else:
                        yield (Picture(decoded_image(frame), time.monotonic()),)
        except self._error as error:
            raise InputError(f"{self.name} broke off: {error.strerror or type(error).__name__}") from error

    def close(self) -> None:
        """Ends the connection."""
        self._container.close()
