"""PNG: the chunks that make up the still picture, without animation, metadata and colour profiles."""

import struct
import zlib

from stereokit.data.image_formats.encoded import EncodedImage, decode_with_opencv

__all__ = ["PNG_MAGIC", "read_png"]

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_DECODED = {b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"}
_CHANNELS = {0: 1, 2: 3, 3: 4, 4: 4, 6: 4}


def read_png(data: bytes) -> EncodedImage:
    """Checks every chunk, and leaves to the decoder those that make up the picture.

    Of an animated PNG that is the still picture that every viewer can show. Its animation chunks would crash OpenCV's
    decoder, and metadata is none of our business.

    Raises:
        ValueError: a broken or truncated file.
    """
    if data[12:16] != b"IHDR":
        raise ValueError("its first chunk is not IHDR")
    width, height, depth, colour = struct.unpack_from(">IIBB", data, 16)
    if colour not in _CHANNELS or depth not in (1, 2, 4, 8, 16):
        raise ValueError(f"its header names colour type {colour} and {depth} bits, which PNG does not have")
    picture, at, kind = [PNG_MAGIC], len(PNG_MAGIC), b""
    while kind != b"IEND":
        if at + 12 > len(data):
            raise ValueError("the PNG ends early")
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data):
            raise ValueError("the PNG ends early")
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(memoryview(data)[at + 4 : end - 4]) != checksum:
            raise ValueError(f"the checksum of its {kind.decode('latin-1')!r} chunk is wrong")
        if kind in _DECODED:
            picture.append(data[at:end])
        elif not kind[0] & 0x20:
            raise ValueError(f"its chunk {kind.decode('latin-1')!r} is none that PNG knows")
        at = end
    return EncodedImage(
        "PNG", width, height, _CHANNELS[colour], 1 + (depth == 16), lambda: decode_with_opencv(b"".join(picture))
    )
