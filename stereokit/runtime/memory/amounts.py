"""Amounts of memory, in and out of text."""

import re
from typing import TypeAlias

from stereokit.errors import ConfigError

__all__ = ["MemorySize", "format_memory", "parse_memory"]

MemorySize: TypeAlias = int | str
"""Bytes, or a text such as "4GiB", "500 MB" or "1.5G"."""


UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12, "KI": 2**10, "MI": 2**20, "GI": 2**30, "TI": 2**40}
"""Powers of 1000 (GB) and of 1024 (GiB)."""


def parse_memory(size: MemorySize) -> int:
    """An amount of memory in bytes.

    Raises:
        ConfigError: not a positive amount.

    >>> parse_memory("4GiB") == 4 * 2**30, parse_memory("500 MB"), parse_memory(1024)
    (True, 500000000, 1024)
    """
    if isinstance(size, str):
        found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?I?)B?", size.strip().upper())
        nbytes = int(float(found[1]) * UNITS[found[2]]) if found and found[2] in UNITS else 0
    else:
        nbytes = 0 if isinstance(size, bool) or not isinstance(size, int) else size
    if nbytes <= 0:
        raise ConfigError(f"{size!r} is no amount of memory; use bytes, or a text such as '4GiB' or '500MB'")
    return nbytes


def format_memory(nbytes: float) -> str:
    """Bytes for people to read.

    >>> format_memory(3 * 2**29), format_memory(5 * 2**20)
    ('1.5 GiB', '5 MiB')
    """
    return f"{nbytes / 2**30:.1f} GiB" if nbytes >= 2**30 else f"{nbytes / 2**20:.0f} MiB"
