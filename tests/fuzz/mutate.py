"""Damage by number: the same number damages the same file in the same way."""

import random
import struct
import zlib

__all__ = ["mutated", "with_checksums"]

_BYTES = [
    b"\xff" * 4, b"\0" * 4, b"\x7f\xff\xff\xff", b"\x80\0\0\0", b"\xff\xff", b"\0\1", b"\x00\x00\x00\x01", b"\n", b"\0",
    b"1000000000", b"-1", b"nan", b"inf", b"1e999", b"#", b"'", b'"', b"\\", b"[", b"]", b"{", b"}", b"=", b",", b" ",
    b"true", b"null", b"../", b"\xef\xbb\xbf", b"\xc3\x28", b"\x1b[31m", b"\r\n", b"0x10", b"1_000", b"1979-05-27",
]  # fmt: skip


def mutated(seeds: list[bytes], kind: str, number: int) -> bytes:
    """One of the files with one to six pieces of damage."""
    rng = random.Random(f"{kind} {number}")
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.choice([1, 1, 1, 2, 3, 6])):
        _damage(data, rng, seeds)
    return bytes(data)


def _damage(data: bytearray, rng: random.Random, seeds: list[bytes]) -> None:
    # headers are where it hurts
    end = rng.choice([32, 128, len(data) + 1])
    at = rng.randrange(min(end, len(data) + 1))
    way = rng.randrange(9)
    if way == 0 and at < len(data):
        data[at] ^= 1 << rng.randrange(8)
    elif way == 1 and at < len(data):
        data[at] = rng.randrange(256)
    elif way == 2:
        noise = rng.choice(_BYTES)
        data[at : at + len(noise)] = noise
    elif way == 3:
        data[at:at] = rng.choice(_BYTES)
    elif way == 4:
        del data[at:]
    elif way == 5:
        del data[at : at + rng.choice([1, 2, 4, 8, 50])]
    elif way == 6:
        piece = data[at : at + rng.choice([1, 4, 12, 60])]
        to = rng.randrange(len(data) + 1)
        data[to:to] = piece * rng.choice([1, 1, 2, 200])
    elif way == 7:
        other = rng.choice(seeds)
        data[at:] = other[rng.randrange(len(other) + 1) :]
    else:
        number = rng.choice([0, 1, 2**7, 2**8 - 1, 2**15, 2**16 - 1, 2**24, 2**31 - 1, 2**32 - 1])
        form = rng.choice("<>") + ("H" if number < 2**16 and rng.random() < 0.5 else "I")
        packed = struct.pack(form, number)
        data[at : at + len(packed)] = packed


def with_checksums(data: bytes) -> bytes:
    """A damaged PNG whose checksums are right, so that the decoder sees the damage."""
    out, at = bytearray(data[:8]), 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        length = min(length, len(data) - at - 12)
        body = data[at + 4 : at + 8 + length]
        out += struct.pack(">I", length) + body + struct.pack(">I", zlib.crc32(body))
        at += 12 + length
    return bytes(out)
