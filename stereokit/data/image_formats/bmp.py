"""BMP, uncompressed."""

import struct

from stereokit.data.image_formats.encoded import EncodedImage, decode_with_opencv

__all__ = ["read_bmp"]

_CORE_HEADER = 12
_BITS = (1, 4, 8, 16, 24, 32)


def read_bmp(data: bytes) -> EncodedImage:
    """Reads the header, and checks that all pixels are there.

    Raises:
        ValueError: a broken, truncated or compressed file. Run lengths may leave pixels out, and a decoder then gives
            what memory held.
    """
    start, length = struct.unpack_from("<II", data, 10)
    if length == _CORE_HEADER:
        width, height, bits, compression = *struct.unpack_from("<HH2xH", data, 18), 0
    else:
        width, height, bits, compression = struct.unpack_from("<ii2xHI", data, 18)
    if bits not in _BITS:
        raise ValueError(f"its header names {bits} bits per pixel, which BMP does not have")
    if compression not in (0, 3):
        raise ValueError("it is a compressed BMP; save it as PNG")
    row = (max(width, 0) * bits + 31) // 32 * 4
    if start + row * abs(height) > len(data) and width * abs(height) <= 8 * len(data):
        raise ValueError("the BMP ends early")
    return EncodedImage("BMP", width, abs(height), 4, 1, lambda: decode_with_opencv(data))
