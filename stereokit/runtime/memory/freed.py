"""What becomes of memory that tensors free."""

import ctypes
import sys

__all__ = ["hand_back_memory", "keep_freed_memory"]

# parameters of mallopt, from malloc.h of the GNU C library
TRIM_THRESHOLD = -1
MMAP_MAX = -4
LARGEST = 2**31 - 1


def keep_freed_memory() -> bool:
    """Lets this process keep the memory that tensors on the CPU free, for the next ones.

    PyTorch asks the C library anew for every tensor. The GNU one gives large ones back to the system as soon as they
    are freed, so that each result of a layer is mapped, cleared and touched page by page again: on small machines that
    can take as long as the arithmetic. Here the process keeps what it once had, as PyTorch does on a GPU.

    It holds for the whole process and all of its libraries, and can't be undone: the process stays as large as it once
    was. The `stereokit` command does it; a program that calls the library decides for itself.

    Returns:
        Whether the C library took the settings; False on systems without the GNU C library, where nothing changes.

    Source: mallopt(3), M_MMAP_MAX and M_TRIM_THRESHOLD.

    >>> keep_freed_memory()  # doctest: +SKIP
    True
    """
    if not sys.platform.startswith("linux"):
        return False
    library = ctypes.CDLL(None)
    # musl has no mallopt
    if not hasattr(library, "mallopt"):
        return False
    return bool(library.mallopt(MMAP_MAX, 0)) and bool(library.mallopt(TRIM_THRESHOLD, LARGEST))


def hand_back_memory() -> None:
    """Gives the system back what the C library keeps of freed tensors, see `stereokit.optimize.keep_freed_memory`.

    Does nothing but on Linux with the GNU C library.

    Source: malloc_trim(3).

    >>> hand_back_memory()
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
