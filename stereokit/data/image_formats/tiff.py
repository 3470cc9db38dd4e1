"""TIFF, decoded here.

OpenCV's decoder multiplies colours by alpha, turns pictures by their orientation tag, gives zeros for what a damaged
strip lacks, and reads planar floats from beyond their buffer, all without a word.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from stereokit.data.image_formats.encoded import EncodedImage, Samples
from stereokit.data.image_formats.lzw import decode_lzw

__all__ = ["TIFF_MAGICS", "read_tiff"]

TIFF_MAGICS = (b"II*\0", b"MM\0*")
_TAGS = {
    256: "width",
    257: "height",
    258: "bits",
    259: "compression",
    262: "photometric",
    266: "fill order",
    273: "strip offsets",
    277: "bands",
    278: "rows per strip",
    279: "strip sizes",
    284: "planar",
    317: "predictor",
    320: "palette",
    322: "tile width",
    323: "tile height",
    324: "tile offsets",
    325: "tile sizes",
    339: "sample format",
}
_MOST_CHUNKS = 2**16
_FIELD = {1: "B", 3: "H", 4: "I"}
_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE = range(4)
_TYPES = {(1, 1): "u1", (1, 8): "u1", (1, 16): "u2", (3, 16): "f2", (3, 32): "f4", (3, 64): "f8"}


def read_tiff(data: bytes) -> EncodedImage:
    """Reads the first picture's directory: 1, 8 or 16 bits or floating point, in strips or tiles.

    Of more than one band, 3 or 4 are taken for red, green, blue (and alpha or infrared), 2 for grey and alpha.

    Raises:
        ValueError: a broken file, or one of a kind that is not read; the message says which.
    """
    layout = _Layout.read(data)
    return EncodedImage(
        "TIFF",
        layout.width,
        layout.height,
        3 if layout.palette is not None else layout.bands,
        np.dtype(layout.type).itemsize,
        layout.decode,
        copies=4,
    )


@dataclass(frozen=True)
class _Layout:
    """Where a picture's samples lie, and how they are stored. A chunk is a strip or a tile."""

    data: bytes
    order: str
    width: int
    height: int
    bands: int
    bits: int
    type: str
    photometric: int
    compression: int
    predictor: int
    planar: bool
    chunk_width: int
    chunk_height: int
    tiled: bool
    offsets: tuple[int, ...]
    sizes: tuple[int, ...]
    palette: Samples | None

    @classmethod
    def read(cls, data: bytes) -> "_Layout":
        order = "<" if data.startswith(b"II") else ">"
        fields = dict(_fields(data, order))

        def one(name: str, default: int | None = None) -> int:
            values = set(fields.get(name, () if default is None else (default,)))
            if len(values) != 1:
                raise ValueError(f"the TIFF names {'several values' if values else 'no value'} for its {name}")
            return values.pop()

        width, height, bands, bits = one("width"), one("height"), one("bands", 1), one("bits", 1)
        photometric, kind = one("photometric"), one("sample format", 1)
        kind = 1 if kind == 4 else kind
        if (kind, bits) not in _TYPES:
            name = {1: "unsigned", 2: "signed", 3: "floating-point"}.get(kind, "unknown")
            raise ValueError(f"it holds {name} samples of {bits} bits; expected 1, 8, 16, or floating point")
        if photometric not in (_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE) or (photometric == 0 and kind == 3):
            raise ValueError(f"its colours are of kind {photometric}, which is not read; save it as RGB or grey")
        grey_bands = (1,) if photometric == _PALETTE or bits == 1 else (1, 2, 3, 4)
        if bands not in ((3, 4) if photometric == _RGB else grey_bands):
            raise ValueError(f"it has {bands} bands; expected 1 (grey), 3 (RGB) or 4: write red, green and blue alone")
        if one("fill order", 1) != 1:
            raise ValueError("its bits are in reversed order, which is not read; save it as PNG")
        palette = np.array(fields.get("palette", ()), np.uint32)
        if photometric == _PALETTE and (bits != 8 or palette.size != 3 * 256):
            raise ValueError("its palette is not one of 256 colours")
        tiled = "tile width" in fields
        part = "tile" if tiled else "strip"
        chunk_height = one("tile height") if tiled else min(one("rows per strip", height), height)
        layout = cls(
            data=data,
            order=order,
            width=width,
            height=height,
            bands=bands,
            bits=bits,
            type=_TYPES[kind, bits],
            photometric=photometric,
            compression=one("compression", 1),
            predictor=one("predictor", 1),
            planar=one("planar", 1) == 2 and bands > 1,
            chunk_width=one("tile width") if tiled else width,
            chunk_height=chunk_height,
            tiled=tiled,
            offsets=fields.get(f"{part} offsets", ()),
            sizes=fields.get(f"{part} sizes", ()),
            palette=palette.reshape(3, 256).T if photometric == _PALETTE else None,
        )
        layout.check()
        return layout

    def check(self) -> None:
        """Refuses, before memory is reserved, what can't be decoded."""
        if min(self.width, self.height, self.chunk_width, self.chunk_height) < 1:
            # the size is judged where all formats' are, but a strip must have one
            if min(self.width, self.height) < 1:
                return
            raise ValueError("its strips or tiles have no size")
        if self.tiled and self.chunk_width * self.chunk_height > max(4 * self.width * self.height, 2**20):
            raise ValueError(f"it claims tiles of {self.chunk_width} x {self.chunk_height} pixels")
        if self.compression not in (1, 5, 8, 32773, 32946):
            raise ValueError(
                f"it is compressed by method {self.compression}, which is not read; save it uncompressed, or with LZW "
                "or Deflate"
            )
        allowed = (1,) if self.bits == 1 else (1, 3) if self.type.startswith("f") else (1, 2)
        if self.predictor not in allowed:
            raise ValueError(f"its predictor is {self.predictor}, which does not go with {self.bits} bits")

    def decode(self) -> Samples:
        down, across = (math.ceil(a / b) for a, b in ((self.height, self.chunk_height), (self.width, self.chunk_width)))
        planes = self.bands if self.planar else 1
        if planes * down * across > _MOST_CHUNKS:
            raise ValueError(
                f"it is cut into {planes * down * across} strips or tiles; expected at most {_MOST_CHUNKS}"
            )
        if min(len(self.offsets), len(self.sizes)) < planes * down * across:
            raise ValueError(f"the TIFF names fewer than its {planes * down * across} strips or tiles")
        image = np.empty((self.height, self.width, self.bands), self.type)
        for number in range(planes * down * across):
            plane, place = divmod(number, down * across)
            row, column = place // across * self.chunk_height, place % across * self.chunk_width
            rows = self.chunk_height if self.tiled else min(self.chunk_height, self.height - row)
            chunk = self._chunk(number, rows)
            bands = slice(plane, plane + 1) if self.planar else slice(None)
            target = image[row : row + rows, column : column + self.chunk_width, bands]
            target[...] = chunk[: target.shape[0], : target.shape[1]]
        return self._as_shown(image)

    def _chunk(self, number: int, rows: int) -> Samples:
        bands = 1 if self.planar else self.bands
        row_bytes = (self.chunk_width * bands * self.bits + 7) // 8
        begin, expected = self.offsets[number], rows * row_bytes
        raw = _unpacked(self.data[begin : begin + self.sizes[number]], self.compression, expected)
        if len(raw) < expected:
            raise ValueError("the TIFF's pixels end early")
        if self.bits == 1:
            bit_rows = np.unpackbits(np.frombuffer(raw, np.uint8).reshape(rows, row_bytes), axis=1)
            return bit_rows[:, : self.chunk_width, None] * np.uint8(255)
        if self.predictor == 3:
            return _undo_float_differences(raw, rows, bands, self.type).reshape(rows, self.chunk_width, bands)
        values = np.frombuffer(raw, self.order + self.type).reshape(rows, self.chunk_width, bands)
        if self.predictor == 2:
            values = np.cumsum(values.astype(self.type), axis=1, dtype=self.type)
        return values

    def _as_shown(self, image: Samples) -> Samples:
        if self.palette is not None:
            colours = self.palette >> 8 if self.palette.max() > 255 else self.palette
            return colours.astype(np.uint8)[image[:, :, 0]]
        if self.photometric == _WHITE_IS_ZERO:
            np.invert(image, out=image)
        return image[:, :, 0] if self.bands < 3 else image


def _fields(data: bytes, order: str) -> Iterator[tuple[str, tuple[int, ...]]]:
    """The directory's fields that matter, each with its values."""
    (at,) = struct.unpack_from(order + "I", data, 4)
    (count,) = struct.unpack_from(order + "H", data, at)
    seen = set()
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind, length = struct.unpack_from(order + "HHI", data, entry)
        if tag not in _TAGS:
            continue
        if tag in seen or kind not in _FIELD or length < 1:
            raise ValueError(f"the TIFF's field for its {_TAGS[tag]} is broken")
        seen.add(tag)
        place, size = entry + 8, struct.calcsize(_FIELD[kind]) * length
        if size > 4:
            (place,) = struct.unpack_from(order + "I", data, place)
        if place + size > len(data):
            raise ValueError(f"the TIFF's field for its {_TAGS[tag]} lies beyond its end")
        yield _TAGS[tag], struct.unpack_from(f"{order}{length}{_FIELD[kind]}", data, place)


def _unpacked(data: bytes, compression: int, expected: int) -> bytes:
    if compression == 5:
        return decode_lzw(data, expected)
    if compression in (8, 32946):
        try:
            return zlib.decompressobj().decompress(data, expected)
        except zlib.error as error:
            raise ValueError(f"its Deflate data is damaged ({error})") from error
    return _undo_packbits(data, expected) if compression == 32773 else data[:expected]


def _undo_packbits(data: bytes, expected: int) -> bytes:
    out, at = bytearray(), 0
    while at < len(data) and len(out) < expected:
        head = data[at]
        if head < 128:
            out += data[at + 1 : at + 2 + head]
            at += 2 + head
        else:
            out += data[at + 1 : at + 2] * (257 - head if head > 128 else 0)
            at += 2 if head > 128 else 1
    return bytes(out[:expected])


def _undo_float_differences(raw: bytes, rows: int, bands: int, kind: str) -> Samples:
    """Bytes were sorted by significance, the most significant first, and stored as differences."""
    size = np.dtype(kind).itemsize
    differences = np.frombuffer(raw, np.uint8).reshape(rows, -1, bands)
    planes = np.cumsum(differences, axis=1, dtype=np.uint8).reshape(rows, size, -1)
    return np.ascontiguousarray(planes.transpose(0, 2, 1)).view(f">{kind}").astype(kind)
