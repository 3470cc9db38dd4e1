"""A live source, of which only the newest counts."""

import threading
from collections.abc import Iterator

from stereokit.errors import InputError
from stereokit.video.frames import Shot, Source

__all__ = ["Newest"]


class Newest:
    """Reads a live source in a thread, as fast as it gives, and hands out the newest that nobody has had.

    Args:
        source: is read to its end, or until `close`.
        stall_seconds: to wait for a frame before the source counts as stalled.

    Attributes:
        dropped: shots that a newer one replaced before somebody took them.
    """

    def __init__(self, source: Source, stall_seconds: float) -> None:
        self.source = source
        self.stall_seconds = stall_seconds
        self.dropped = 0
        self._newest: Shot | None = None
        self._failure: Exception | None = None
        self._ended = self._closed = False
        self._changed = threading.Condition()
        # a thread that waits for a dead camera must not keep the program from ending
        self._thread = threading.Thread(target=self._read, name=f"reads {source.name}", daemon=True)

    def __iter__(self) -> Iterator[Shot]:
        """The newest shot each time, until the source ends.

        Raises:
            InputError: the source stalls or breaks off.
        """
        if self._thread.ident is None:
            self._thread.start()
        while (shot := self._take()) is not None:
            yield shot

    def close(self) -> None:
        """Tells the thread to end; it lets go of the source itself, which it may be reading."""
        with self._changed:
            self._closed = True
        if self._thread.ident is None:
            self.source.close()
        else:
            self._thread.join(timeout=1)

    def _take(self) -> Shot | None:
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._ended, self.stall_seconds)
            shot, self._newest = self._newest, None
            if shot is None and self._failure is not None:
                raise self._failure
            if shot is None and not self._ended:
                raise InputError(f"{self.source.name} has given no frame for {self.stall_seconds:g} s: it stalls")
            return shot

    def _read(self) -> None:
        try:
            for shot in self.source:
                with self._changed:
                    if self._closed:
                        break
                    self.dropped += self._newest is not None
                    self._newest = shot
                    self._changed.notify()
        except Exception as error:
            self._failure = error
        finally:
            self.source.close()
            with self._changed:
                self._ended = True
                self._changed.notify()
