"""TIFF's variant of LZW, decoded a table at a time with arrays."""

import numpy as np
import numpy.typing as npt

__all__ = ["decode_lzw"]

_CLEAR, _END, _FIRST = 256, 257, 258
_MOST = 4096 - _FIRST
# The width of a code depends on how many came since the table was cleared, so all of them can be read at once.
_WIDTHS = 9 + np.searchsorted([511, 1023, 2047], _FIRST + np.maximum(np.arange(_MOST) - 1, 0), side="right")
_OFFSETS = np.concatenate(([0], np.cumsum(_WIDTHS)))


def decode_lzw(data: bytes, expected: int) -> bytes:
    """The first `expected` bytes of an LZW stream, fewer where it ends before them.

    Raises:
        ValueError: a code that no encoder writes.

    Source: TIFF revision 6.0, section 13.

    >>> decode_lzw(bytes([0x80, 0x10, 0x60, 0x50, 0x10]), 3)
    b'AAA'
    """
    padded = np.frombuffer(data + bytes(4), np.uint8).astype(np.uint32)
    at, bits, out = 0, 8 * len(data), bytearray()
    while len(out) < expected:
        places = at + _OFFSETS[:-1]
        there = int(np.searchsorted(places + _WIDTHS, bits, side="right"))
        if there == 0:
            break
        places, widths = places[:there], _WIDTHS[:there]
        first = places >> 3
        window = padded[first] << 16 | padded[first + 1] << 8 | padded[first + 2]
        codes = (window >> (24 - (places & 7) - widths)) & ((1 << widths) - 1)
        stops = np.flatnonzero((codes == _CLEAR) | (codes == _END))
        length = int(stops[0]) if len(stops) else there
        out += _strings(codes[:length].astype(np.int64)).tobytes()
        if not len(stops) or codes[length] == _END:
            break
        at += int(_OFFSETS[length + 1])
    return bytes(out[:expected])


def _strings(codes: npt.NDArray[np.int64]) -> npt.NDArray[np.uint8]:
    """What the codes between two clearings stand for. Entry j is string j and the next one's first byte."""
    if len(codes) == 0:
        return np.empty(0, np.uint8)
    if codes[0] >= _CLEAR or (codes[1:] > _FIRST + np.arange(len(codes) - 1)).any():
        raise ValueError("its LZW data holds a code that is not in the table")
    parents = np.concatenate((np.arange(_FIRST), codes))
    roots, lengths = parents.copy(), (np.arange(len(parents)) >= _FIRST).astype(np.int64)
    while (roots >= _FIRST).any():
        # twice as far up with every turn
        lengths += lengths[roots]
        roots = roots[roots]
    lengths += 1
    last = np.concatenate((np.arange(_FIRST), roots[codes[1:]], [0])).astype(np.uint8)
    ends = np.cumsum(lengths[codes])
    out = np.empty(int(ends[-1]), np.uint8)
    nodes, places = codes, ends - 1
    while len(nodes):
        out[places] = last[nodes]
        longer = nodes >= _FIRST
        nodes, places = parents[nodes[longer]], places[longer] - 1
    return out
