"""How much memory there is, and what happens where it runs out."""

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from stereokit.errors import InputError

__all__ = ["available_memory", "running_out_as"]


def available_memory(device: str | torch.device = "cpu") -> int | None:
    """The free memory of a device in bytes; None where the system does not tell.

    Of a GPU what the driver calls free and what torch holds unused. Of the CPU what Linux calls available, within the
    limit of the container; on other systems all the memory that is built in. What this process keeps of freed tensors
    counts as taken, see `hand_back_memory`.

    >>> available = available_memory("cpu")
    >>> available is None or available > 0
    True
    """
    device = torch.device(device)
    if device.type == "cuda" and not torch.cuda.is_available():
        # a runtime of exported files may use what torch was not built for
        return None
    if device.type == "cuda":
        held_unused = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + held_unused
    limits = [limit for limit in (_linux_available(), _container_available()) if limit is not None]
    if limits:
        return min(limits)
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def _linux_available(path: Path = Path("/proc/meminfo")) -> int | None:
    try:
        found = re.search(r"^MemAvailable:\s+(\d+) kB", path.read_text(), re.MULTILINE)
    except OSError:
        return None
    return int(found[1]) * 1024 if found else None


def _container_available(folder: Path = Path("/sys/fs/cgroup")) -> int | None:
    """What a limit of control groups, version 2, leaves."""
    try:
        limit, used, parts = ((folder / f"memory.{name}").read_text().strip() for name in ("max", "current", "stat"))
    except OSError:
        return None
    if limit == "max":
        return None
    # pages of files that the kernel drops when memory is asked for
    droppable = re.search(r"^inactive_file (\d+)$", parts, re.MULTILINE)
    return max(0, int(limit) - int(used) + (int(droppable[1]) if droppable else 0))


@contextmanager
def running_out_as(message: str) -> Iterator[None]:
    """Turns an allocation that fails in its block, on any device, into an `InputError`.

    >>> with running_out_as("too large"):
    ...     torch.empty(2**55)
    Traceback (most recent call last):
    stereokit.errors.InputError: too large
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        # a failure of the CPU's allocator has no class of its own
        if isinstance(error, torch.OutOfMemoryError | MemoryError) or "can't allocate memory" in str(error):
            raise InputError(message) from error
        raise
