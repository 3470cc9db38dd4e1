"""Damage inside of what holds the data, so that readers get past the container."""

import copy
import io
import json
import random
import struct
import zipfile
from collections.abc import Callable
from typing import Any

from tests.fuzz.mutate import mutated

__all__ = ["json_damaged", "safetensors_damaged", "zip_damaged"]

_ODD: list[Any] = [
    0, -1, 1, 3, 7, 2**31, 2**40, 0.5, 1e308, float("inf"), float("nan"), True, False, None, "", "coex", "none",
    "x" * 5000, "\x1b[31m", "\ud800", [], {}, [1], [[[]]], {"name": "coex"}, {"name": []}, [0.5] * 3, [None, "a"],
]  # fmt: skip


def json_damaged(seeds: list[bytes], kind: str, number: int) -> bytes:
    """Valid JSON with one to three changes of its values or names; every third input is damaged byte by byte."""
    rng = random.Random(f"json {kind} {number}")
    if number % 3 == 0:
        return mutated(seeds, kind, number)
    document = json.loads(rng.choice(seeds))
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        document = _changed(document, rng)
    return json.dumps(document).encode()


def safetensors_damaged(seeds: list[bytes], kind: str, number: int) -> bytes:
    """Weights whose header is changed as JSON, or whose numbers are; every third input is damaged byte by byte."""
    rng = random.Random(f"safetensors {kind} {number}")
    if number % 3 == 0:
        return mutated(seeds, kind, number)
    seed = rng.choice(seeds)
    (length,) = struct.unpack_from("<Q", seed)
    header, data = seed[8 : 8 + length], bytearray(seed[8 + length :])
    if number % 3 == 1:
        header = json_damaged([header], kind, 3 * number + 1)
    else:
        for _ in range(rng.choice([1, 4, 40])):
            data[rng.randrange(len(data))] = rng.choice([0, 0x7F, 0x80, 0xFF, rng.randrange(256)])
    return struct.pack("<Q", len(header)) + header + bytes(data)


def zip_damaged(seeds: list[bytes], kind: str, number: int) -> bytes:
    """An archive with one damaged member and right checksums; every third input is damaged byte by byte."""
    if number % 3 == 0:
        return mutated(seeds, kind, number)
    rng = random.Random(f"zip {kind} {number}")
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(rng.choice(seeds))) as seed, zipfile.ZipFile(buffer, "w") as archive:
        members = seed.infolist()
        chosen = rng.choice(members)
        for member in members:
            content = seed.read(member)
            if member is chosen:
                content = mutated([content], kind, number)
            archive.writestr(member.filename, content, member.compress_type)
    return buffer.getvalue()


def _changed(document: Any, rng: random.Random) -> Any:
    """The document with one change at some place of it."""
    inside = isinstance(document, dict | list) and len(document) > 0
    if not inside or rng.random() < 0.1:
        return copy.deepcopy(rng.choice(_ODD))
    key = rng.choice(list(document) if isinstance(document, dict) else range(len(document)))
    ways: list[Callable[[], Any]] = [
        lambda: document.__setitem__(key, _changed(document[key], rng)),
        lambda: document.__setitem__(key, _changed(document[key], rng)),
        # copies, since what is put in may be changed in turn
        lambda: document.__setitem__(key, copy.deepcopy(rng.choice(_ODD))),
        lambda: document.__setitem__(
            key, copy.deepcopy(rng.choice(list(document.values() if isinstance(document, dict) else document)))
        ),
        lambda: document.pop(key),
    ]
    if isinstance(document, dict):
        ways.append(
            lambda: document.__setitem__(
                rng.choice([f"{key}_", "pretrained", "y" * 500, "instance"]), copy.deepcopy(document[key])
            )
        )
    rng.choice(ways)()
    return document
