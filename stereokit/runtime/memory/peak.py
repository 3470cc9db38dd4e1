"""Peak memory of what runs in this process."""

import gc
from pathlib import Path

import torch

from stereokit.runtime.memory.freed import hand_back_memory

__all__ = ["PeakMemory"]

STATUS = Path("/proc/self/status")
CLEAR = Path("/proc/self/clear_refs")


class PeakMemory:
    """The memory that is taken from here on, at its peak.

    On a CPU it is the process's resident memory at its high-water mark, less what was resident at the start, after
    everything free was handed back to the system; only Linux tells it. On CUDA it is the most that torch's allocator
    gave out, less what it had given out at the start; other libraries on the GPU are not seen.

    Args:
        device: whose memory.

    >>> peak = PeakMemory("cpu")
    >>> peak.bytes() is None or peak.bytes() >= 0
    True
    """

    def __init__(self, device: str | torch.device) -> None:
        self.device = torch.device(device)
        gc.collect()
        self._start = 0
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
            torch.cuda.reset_peak_memory_stats(self.device)
            self._start = torch.cuda.memory_allocated(self.device)
        elif self.device.type == "cpu":
            self.restart()
            self._start = _status("VmRSS") or 0

    def restart(self) -> None:
        """Forgets the peak, but not the start: what was taken since and is still held stays counted."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
            return
        # else what was freed and is kept counts as held, see `keep_freed_memory`
        hand_back_memory()
        try:
            # 5 sets the high-water mark to what is resident now
            CLEAR.write_text("5")
            self._known = True
        except OSError:
            self._known = False

    def bytes(self) -> int | None:
        """The peak so far, in bytes; None where the system does not tell it."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
            return torch.cuda.max_memory_allocated(self.device) - self._start
        if self.device.type != "cpu" or not self._known or (peak := _status("VmHWM")) is None:
            return None
        return max(0, peak - self._start)


def _status(key: str) -> int | None:
    try:
        for line in STATUS.read_text().splitlines():
            if line.startswith(f"{key}:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return None
