"""Memory: what a pass needs, what there is, what it took, and what becomes of what is freed."""

from stereokit.runtime.memory.amounts import MemorySize, format_memory, parse_memory
from stereokit.runtime.memory.available import available_memory, running_out_as
from stereokit.runtime.memory.estimate import estimate_memory
from stereokit.runtime.memory.freed import hand_back_memory, keep_freed_memory
from stereokit.runtime.memory.peak import PeakMemory

__all__ = [
    "MemorySize",
    "PeakMemory",
    "available_memory",
    "estimate_memory",
    "format_memory",
    "hand_back_memory",
    "keep_freed_memory",
    "parse_memory",
    "running_out_as",
]
