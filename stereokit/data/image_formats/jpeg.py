"""JPEG: the segments that make up the picture, without metadata."""

import re
import struct

from stereokit.data.image_formats.encoded import EncodedImage, decode_with_opencv

__all__ = ["read_jpeg"]

_MARKER = re.compile(rb"\xff[^\x00\xff]")
_MARKER_AFTER_PIXELS = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_JFIF, _ADOBE, _COMMENT = 0xE0, 0xEE, 0xFE
_SCANNED_PIXELS = 10**9


def read_jpeg(data: bytes) -> EncodedImage:
    """Walks through all segments, and leaves to the decoder those that make up the picture.

    Bytes between segments are skipped, as decoders do. The end marker must be there: decoders fill what is missing with
    grey.

    Raises:
        ValueError: a broken or truncated file, 12 bits per sample, or more passes over the picture than a camera or an
            encoder makes, which can keep a decoder busy for hours.
    """
    picture, at, frame, scans, markers = [b"\xff\xd8"], 2, None, 0, _MARKER
    while found := markers.search(data, at):
        # what a scan holds stands before the marker that ends it
        picture.append(data[at : found.start()] if markers is _MARKER_AFTER_PIXELS else b"")
        marker, begin = data[found.end() - 1], found.end()
        markers, at = _MARKER, begin
        if marker == 0xD9:
            break
        if marker == 0x01 or 0xD0 <= marker <= 0xD8:  # without a payload
            continue
        (length,) = struct.unpack_from(">H", data, begin)
        at = begin + max(length, 2)
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            frame = struct.unpack_from(">BHHB", data, begin + 2)
        if marker == 0xDA:
            scans, markers = scans + 1, _MARKER_AFTER_PIXELS
        if marker in (_JFIF, _ADOBE) or not (0xE0 <= marker <= 0xEF or marker == _COMMENT):
            picture.append(data[found.start() : at])
    if found is None:
        raise ValueError("the JPEG ends early: it has no end marker")
    if frame is None or not scans:
        raise ValueError("the JPEG holds no picture")
    bits, height, width, channels = frame
    if bits != 8:
        raise ValueError(f"it is a JPEG of {bits} bits per sample; expected 8")
    if scans * width * height > _SCANNED_PIXELS and scans > 1:
        raise ValueError(f"it goes over its {width} x {height} pixels {scans} times; save it as PNG")
    picture.append(b"\xff\xd9")
    return EncodedImage(
        "JPEG", width, height, 1 if channels == 1 else 3, 1, lambda: decode_with_opencv(b"".join(picture))
    )
