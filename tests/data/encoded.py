"""Encoded images, made byte by byte, so that tests can write what no encoder does."""

import struct
import zlib

import cv2
import numpy as np


def encode(suffix, samples, parameters=()):
    """With OpenCV; RGB."""
    bgr = samples[..., [2, 1, 0, 3][: samples.shape[2]]] if samples.ndim == 3 else samples
    return cv2.imencode(suffix, np.ascontiguousarray(bgr), list(parameters))[1].tobytes()


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width, height, depth, colour_type, rows, extra=b""):
    header = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, 0)
    pixels = chunk(b"IDAT", zlib.compress(rows))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + extra + pixels + chunk(b"IEND", b"")


def animated_png(pixels=b"\0\1\2\3\4\5\6\0\7\7\7\7\7\7", frame=b"\0" * 14):
    """2 x 2 RGB with a second frame, whose chunks an animated PNG decoder would follow."""
    control = chunk(b"acTL", struct.pack(">II", 3, 0))
    still = chunk(b"IDAT", zlib.compress(pixels))
    places = chunk(b"fcTL", struct.pack(">5I2HBB", 1, 2, 2, 0, 0, 1, 10, 0, 0))
    second = chunk(b"fdAT", struct.pack(">I", 2) + zlib.compress(frame))
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 2, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + control + still + places + second + chunk(b"IEND", b"")


def packbits(data):
    """As literal runs, and one repeated byte where there are many."""
    if len(data) > 1 and len(data) < 129 and len(set(data)) == 1:
        return bytes([257 - len(data)]) + data[:1]
    return b"".join(bytes([len(data[i : i + 128]) - 1]) + data[i : i + 128] for i in range(0, len(data), 128))


def tiff(samples, *, photometric=None, compression=1, rows=None, tile=None, planar=False, order="<", tags=(), short=0):
    """A TIFF of one picture, in strips of so many rows or in tiles.

    `tags` overrule or add fields; `short` cuts bytes off the end of every strip.
    """
    pack = {1: bytes, 8: zlib.compress, 32773: packbits}[compression]
    stacked = samples[:, :, None] if samples.ndim == 2 else samples
    height, width, bands = stacked.shape
    stacked = stacked.astype(stacked.dtype.newbyteorder(order))
    chunks = []
    for part in [stacked[:, :, i : i + 1] for i in range(bands)] if planar else [stacked]:
        if tile:
            padded = np.pad(part, [(0, -height % tile), (0, -width % tile), (0, 0)])
            grid = [padded[y : y + tile, x : x + tile] for y in range(0, height, tile) for x in range(0, width, tile)]
        else:
            grid = [part[y : y + (rows or height)] for y in range(0, height, rows or height)]
        chunks += [pack(block.tobytes()) for block in grid]
    chunks = [block[: len(block) - short] for block in chunks]
    offsets = [8 + sum(map(len, chunks[:i])) for i in range(len(chunks))]
    kind = {"u": 1, "i": 2, "f": 3}[samples.dtype.kind]
    fields = {
        256: [width],
        257: [height],
        258: [samples.dtype.itemsize * 8] * bands,
        259: [compression],
        262: [(2 if bands >= 3 else 1) if photometric is None else photometric],
        277: [bands],
        284: [1 + planar],
        339: [kind] * bands,
        (324 if tile else 273): offsets,
        (325 if tile else 279): [len(block) for block in chunks],
        **({322: [tile], 323: [tile]} if tile else {278: [rows or height]}),
        **dict(tags),
    }
    fields = {tag: values for tag, values in fields.items() if values is not None}
    body = b"".join(chunks)
    directory, tail = struct.pack(order + "H", len(fields)), b""
    beyond = 8 + len(body) + 2 + 12 * len(fields) + 4
    for tag, values in sorted(fields.items()):
        packed = struct.pack(f"{order}{len(values)}I", *values)
        place = packed if len(packed) <= 4 else struct.pack(order + "I", beyond + len(tail))
        tail += b"" if len(packed) <= 4 else packed
        directory += struct.pack(order + "HHI", tag, 4, len(values)) + place
    magic = b"II*\0" if order == "<" else b"MM\0*"
    return magic + struct.pack(order + "I", 8 + len(body)) + body + directory + bytes(4) + tail
