"""WebP: a still picture, without metadata."""

import struct

from stereokit.data.image_formats.encoded import EncodedImage, decode_with_opencv

__all__ = ["read_webp"]

_ALPHA, _ANIMATION = 0x10, 0x02


def read_webp(data: bytes) -> EncodedImage:
    """Finds the chunks of the picture, and leaves no other to the decoder.

    Raises:
        ValueError: a broken, truncated or animated file.
    """
    if data[8:12] != b"WEBP":
        raise ValueError("it is a RIFF file, but no WebP")
    size, chunks, at = None, [], 12
    while at + 8 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, at)
        payload, at = data[at + 8 : at + 8 + length], at + 8 + length + length % 2
        if kind in (b"ANIM", b"ANMF") or (kind == b"VP8X" and payload[0] & _ANIMATION):
            raise ValueError("it is an animated WebP; save one frame as PNG")
        if kind not in (b"VP8X", b"ALPH", b"VP8 ", b"VP8L"):
            continue
        if len(payload) < length:
            raise ValueError("the WebP ends early")
        if kind == b"VP8X":
            payload = bytes([payload[0] & _ALPHA]) + payload[1:]
        size = size or _size(kind, payload)
        chunks.append(struct.pack("<4sI", kind, length) + payload + b"\0" * (length % 2))
        if kind in (b"VP8 ", b"VP8L"):
            break
    else:
        raise ValueError("the WebP holds no picture")
    if size is None:
        raise ValueError("the WebP names no size")
    body = b"WEBP" + b"".join(chunks)
    still = b"RIFF" + struct.pack("<I", len(body)) + body
    return EncodedImage("WebP", *size, 4, 1, lambda: decode_with_opencv(still))


def _size(kind: bytes, payload: bytes) -> tuple[int, int] | None:
    if kind == b"VP8X":
        return 1 + int.from_bytes(payload[4:7], "little"), 1 + int.from_bytes(payload[7:10], "little")
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", payload, 1)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", payload, 6)
        return width & 0x3FFF, height & 0x3FFF
    return None
