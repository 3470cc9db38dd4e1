"""Portable bitmaps, greymaps and pixmaps."""

import re

from stereokit.data.image_formats.encoded import EncodedImage, Samples, decode_with_opencv

__all__ = ["read_pnm"]

_BLANK = rb"(?:\s|#[^\n]*\n)+"
_SIZE = re.compile(rb"P([1-6])" + (_BLANK + rb"(\d{1,10})") * 2)
_PEAK = re.compile(_BLANK + rb"(\d{1,5})\s")
_LIMIT = 4096


def read_pnm(data: bytes) -> EncodedImage:
    """Reads the header, and writes it anew for the decoder, so that both understand the same.

    Raises:
        ValueError: a broken or truncated file.
    """
    found = _SIZE.match(data[:_LIMIT])
    if found is None:
        raise ValueError("its header names no kind, width and height as a PNM does")
    kind, width, height = (int(group) for group in found.groups())
    bitmap, peak, at = kind in (1, 4), None, found.end() + 1
    if not bitmap:
        named = _PEAK.match(data[found.end() : found.end() + _LIMIT])
        if named is None or not 0 < int(named[1]) < 65536:
            raise ValueError("the PNM names no largest value between 1 and 65535")
        peak, at = int(named[1]), found.end() + named.end()
    channels, sample_bytes = 3 if kind in (3, 6) else 1, 1 if bitmap or (peak or 0) < 256 else 2
    samples = width * height * channels
    if bitmap:
        needed = samples if kind == 1 else (width + 7) // 8 * height
    else:
        # text has a digit for every sample, and a blank before the next
        needed = 2 * samples - 1 if kind < 4 else samples * sample_bytes
    body = data[at:]

    def decode() -> Samples:
        if len(body) < needed:
            raise ValueError("the PNM ends early")
        head = f"P{kind}\n{width} {height}\n" + ("" if peak is None else f"{peak}\n")
        return decode_with_opencv(head.encode() + body)

    return EncodedImage("PNM", width, height, channels, sample_bytes, decode, peak=peak)
