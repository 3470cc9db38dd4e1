"""Arrays as text that a page can hold, compactly."""

import base64
import json
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["DISPARITY_STEPS", "FINE_STEPS", "pack_bits", "pack_map", "quantised", "with_head"]

FINE_STEPS = 256
"""Of a pixel of disparity, in frames of a stream whose disparities these hold: those below 255.99 px."""

DISPARITY_STEPS = 64
"""Of a pixel of disparity, in a page that holds its results: 1/128 px is the most that is lost."""


def pack_map(codes: npt.NDArray[np.uint16]) -> str:
    """A map of whole numbers (H, W): differences along the rows, low bytes before high ones, zlib, base64.

    >>> len(pack_map(np.arange(600, dtype=np.uint16).reshape(20, 30))) < 150
    True
    """
    wide = codes.astype(np.int32)
    steps = np.diff(wide, axis=1, prepend=0)
    # the first column along the rows, too
    steps[1:, 0] -= wide[:-1, 0]
    wrapped = steps.astype(np.uint16)
    planes = np.concatenate([(wrapped & 255).astype(np.uint8).ravel(), (wrapped >> 8).astype(np.uint8).ravel()])
    return _text(planes.tobytes())


def pack_bits(values: npt.NDArray[Any]) -> str:
    """An array as it is, zlib, base64."""
    return _text(np.ascontiguousarray(values).tobytes())


def quantised(disparity: npt.NDArray[np.float32], steps: int = DISPARITY_STEPS) -> npt.NDArray[np.uint16]:
    """Disparity in steps, so many to a pixel, plus 1; 0 where unknown. Values are held within 0 and 65534 steps.

    >>> quantised(np.array([0, 2.5, np.nan, -1, 2000], np.float32)).tolist()
    [1, 161, 0, 1, 65535]
    """
    codes = disparity * np.float32(steps)
    codes += np.float32(1.5)
    # what is unknown becomes 0, whether it was NaN or infinite
    np.nan_to_num(codes, copy=False, nan=0, posinf=0, neginf=0)
    unknown = ~np.isfinite(disparity)
    result = codes.clip(1, 65535, out=codes).astype(np.uint16)
    result[unknown] = 0
    return result


def with_head(facts: Mapping[str, Any], *parts: bytes) -> bytes:
    """A head in JSON, its length in four bytes before it, and what follows it from a multiple of four on.

    >>> with_head({"a": 1}, b"next")
    b'\\x08\\x00\\x00\\x00{"a": 1}next'
    """
    head = json.dumps(facts).encode()
    head += b" " * (-len(head) % 4)
    return b"".join([len(head).to_bytes(4, "little"), head, *parts])


def _text(content: bytes) -> str:
    return base64.b64encode(zlib.compress(content, 9)).decode()
