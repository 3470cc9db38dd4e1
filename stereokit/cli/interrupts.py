"""Ctrl-C, and being told to end, that wait for what must not be left half done."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

__all__ = ["Terminated", "end_in_order", "finished_before_interrupt"]

_ENDINGS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class Terminated(KeyboardInterrupt):
    """The process was told to end by another signal than Ctrl-C. What ends in order at Ctrl-C does so here too."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def end_in_order() -> None:
    """Lets SIGTERM and SIGHUP raise `Terminated`, so that temporary files go and what was begun is finished.

    Signals that somebody handles or ignores already, as `nohup` does, are left alone.
    """
    for number in _ENDINGS:
        if signal.getsignal(number) == signal.SIG_DFL:
            signal.signal(number, _end)


@contextmanager
def finished_before_interrupt() -> Iterator[None]:
    """A block at whose end Ctrl-C takes effect, if it was pressed within; so do the signals of `end_in_order`.

    Raises:
        KeyboardInterrupt: at the end of the block.
    """
    if threading.current_thread() is not threading.main_thread():
        # signals reach the main thread alone
        yield
        return
    came: list[int] = []
    held = [number for number in (signal.SIGINT, *_ENDINGS) if callable(signal.getsignal(number))]
    before = {number: signal.signal(number, lambda number, frame: came.append(number)) for number in held}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        # as if it came now
        signal.raise_signal(came[0])


def _end(number: int, frame: Any) -> NoReturn:
    raise Terminated(number)
