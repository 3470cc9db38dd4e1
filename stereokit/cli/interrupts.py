"""Ctrl-C that waits for what must not be left half done."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

__all__ = ["finished_before_interrupt"]


@contextmanager
def finished_before_interrupt() -> Iterator[None]:
    """A block at whose end Ctrl-C takes effect, if it was pressed within.

    Raises:
        KeyboardInterrupt: at the end of the block.
    """
    if threading.current_thread() is not threading.main_thread():
        # signals reach the main thread alone
        yield
        return
    pressed: list[Any] = []
    before = signal.signal(signal.SIGINT, lambda *given: pressed.append(given))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt
