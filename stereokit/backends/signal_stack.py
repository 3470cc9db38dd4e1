"""The stack that the handlers of this thread's signals run on."""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["kept_signal_stack"]


class _Stack(ctypes.Structure):
    # stack_t of sigaltstack(2) on Linux
    _fields_ = (("place", ctypes.c_void_p), ("flags", ctypes.c_int), ("size", ctypes.c_size_t))


@contextmanager
def kept_signal_stack() -> Iterator[None]:
    """Puts the signal stack of this thread back at the end of the block, or of the function that it decorates.

    OpenVINO's CPU plugin (seen in 2026.4) leaves a stack of its own in its place, and frees that later on. The next
    signal that Python handles, such as the end of a child process of a data loader, would then end the process.

    Elsewhere than on Linux this does nothing.

    >>> with kept_signal_stack():
    ...     pass
    """
    if not sys.platform.startswith("linux"):
        yield
        return
    library, before = ctypes.CDLL(None), _Stack()
    library.sigaltstack(None, ctypes.byref(before))
    try:
        yield
    finally:
        library.sigaltstack(ctypes.byref(before), None)
