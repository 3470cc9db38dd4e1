"""Which format a file is of, by its first bytes."""

import struct
from collections.abc import Callable

from stereokit.data.image_formats.bmp import read_bmp
from stereokit.data.image_formats.encoded import EncodedImage
from stereokit.data.image_formats.jpeg import read_jpeg
from stereokit.data.image_formats.png import PNG_MAGIC, read_png
from stereokit.data.image_formats.pnm import read_pnm
from stereokit.data.image_formats.tiff import TIFF_MAGICS, read_tiff
from stereokit.data.image_formats.webp import read_webp

__all__ = ["read_header"]

_READERS: dict[bytes, Callable[[bytes], EncodedImage]] = {
    PNG_MAGIC: read_png,
    b"\xff\xd8\xff": read_jpeg,
    b"BM": read_bmp,
    b"RIFF": read_webp,
    **dict.fromkeys(TIFF_MAGICS, read_tiff),
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"), read_pnm),
}


def read_header(data: bytes) -> EncodedImage | None:
    """Format and size of an encoded image, or None where `data` is no image of a known format.

    Of PNG and JPEG files it also checks that the end is there, because decoders fill what is missing with grey.

    Raises:
        ValueError: the file is of a known format but is broken, ends early, or is of a kind that is not read.

    >>> image = read_header(b"P5 2 1 255 ab")
    >>> image.format, image.width, image.height, image.decode().tolist()
    ('PNM', 2, 1, [[97, 98]])
    """
    if data[4:8] == b"ftyp":
        # AVIF, whose box size can look like another format's magic, and which OpenCV would try first
        return None
    try:
        return next((read(data) for magic, read in _READERS.items() if data.startswith(magic)), None)
    except (struct.error, IndexError):
        raise ValueError("it ends within its header") from None
