"""What an image file says of itself, read before anything is decoded.

A few bytes can claim an image of 10^9 pixels, so the size is checked before a decoder reserves memory for it.
"""

import re
import struct
import zlib
from dataclasses import dataclass

__all__ = ["ImageHeader", "read_image_header"]

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNM = re.compile(rb"P([1-6])" + rb"(?:\s|#[^\n]*\n)+(\d{1,10})" * 2)
_PNM_PEAK = re.compile(rb"(?:\s|#[^\n]*\n)+(\d{1,5})\s")
_TIFF_SIZE_TAGS = {256: "width", 257: "height", 322: "tile width", 323: "tile height"}


@dataclass(frozen=True)
class ImageHeader:
    """Format and size of an encoded image.

    Attributes:
        format: "PNG", "JPEG", "PNM", "BMP", "WebP" or "TIFF".
        width: in pixels.
        height: in pixels.
        peak: the sample value that stands for white where the file names one (PNM), else None for the full
            range.
    """

    format: str
    width: int
    height: int
    peak: int | None = None


def read_image_header(data: bytes) -> ImageHeader | None:
    """Format and size of an encoded image, or None where `data` is no image of a known format.

    Of PNG and JPEG files it also checks that the end is there, because decoders fill what is missing with
    grey.

    Raises:
        ValueError: the header is of a known format but is broken, or the file ends early.

    >>> read_image_header(b"P5 640 480 255 ...")
    ImageHeader(format='PNM', width=640, height=480, peak=255)
    """
    try:
        if data.startswith(PNG_MAGIC):
            return _png(data)
        if data.startswith(b"\xff\xd8\xff"):
            return _jpeg(data)
        if data.startswith(b"BM"):
            return _bmp(data)
        if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
            return _webp(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff(data)
    except (struct.error, IndexError):
        raise ValueError("it ends within its header") from None
    if match := _PNM.match(data[:4096]):
        return _pnm(data, match)
    return None


def _png(data: bytes) -> ImageHeader:
    if data[12:16] != b"IHDR":
        raise ValueError("its first chunk is not IHDR")
    width, height = struct.unpack_from(">II", data, 16)
    at, kind = len(PNG_MAGIC), b""
    while kind != b"IEND":
        if at + 12 > len(data):
            raise ValueError("the PNG ends early")
        length, kind = struct.unpack_from(">I4s", data, at)
        if at + 12 + length > len(data):
            raise ValueError("the PNG ends early")
        (checksum,) = struct.unpack_from(">I", data, at + 8 + length)
        if zlib.crc32(memoryview(data)[at + 4 : at + 8 + length]) != checksum:
            raise ValueError(f"the checksum of its {kind.decode('latin-1')!r} chunk is wrong")
        at += 12 + length
    return ImageHeader("PNG", width, height)


def _jpeg(data: bytes) -> ImageHeader:
    at, size = 2, None
    while True:
        if data[at] != 0xFF:
            raise ValueError("a JPEG marker is missing")
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker == 0x01 or 0xD0 <= marker <= 0xD8:  # markers without a payload
            at += 2
            continue
        if marker == 0xD9:
            raise ValueError("the JPEG holds no picture")
        (length,) = struct.unpack_from(">H", data, at + 2)
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            size = struct.unpack_from(">HH", data, at + 5)
        at += 2 + max(length, 2)
        if marker == 0xDA:
            break
    if size is None:
        raise ValueError("the JPEG names no size")
    if data.find(b"\xff\xd9", at) < 0:
        raise ValueError("the JPEG ends early")
    return ImageHeader("JPEG", size[1], size[0])


def _bmp(data: bytes) -> ImageHeader:
    (length,) = struct.unpack_from("<I", data, 14)
    width, height = struct.unpack_from("<HH" if length == 12 else "<ii", data, 18)
    return ImageHeader("BMP", width, abs(height))


def _webp(data: bytes) -> ImageHeader:
    kind = data[12:16]
    if kind == b"VP8X":
        width, height = (1 + int.from_bytes(data[at : at + 3], "little") for at in (24, 27))
    elif kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        width, height = 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    elif kind == b"VP8 ":
        width, height = (side & 0x3FFF for side in struct.unpack_from("<HH", data, 26))
    else:
        raise ValueError("its first chunk is none that WebP knows")
    return ImageHeader("WebP", width, height)


def _tiff(data: bytes) -> ImageHeader:
    order = "<" if data.startswith(b"II") else ">"
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    sizes = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if tag in _TIFF_SIZE_TAGS:
            (sizes[tag],) = struct.unpack_from(order + ("H" if kind == 3 else "I"), data, entry + 8)
    if not {256, 257} <= sizes.keys():
        raise ValueError("the TIFF names no size")
    # A decoder reserves memory for a whole tile, so a tile counts like the image.
    return ImageHeader("TIFF", max(sizes[256], sizes.get(322, 0)), max(sizes[257], sizes.get(323, 0)))


def _pnm(data: bytes, match: re.Match[bytes]) -> ImageHeader:
    kind, width, height = (int(group) for group in match.groups())
    if kind in (1, 4):
        return ImageHeader("PNM", width, height)
    peak = _PNM_PEAK.match(data[match.end() : match.end() + 4096])
    if peak is None or not 0 < int(peak[1]) < 65536:
        raise ValueError("the PNM names no largest value between 1 and 65535")
    return ImageHeader("PNM", width, height, int(peak[1]))
