"""Arrays as text that a page can hold, compactly."""

import base64
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["DISPARITY_STEPS", "pack_bits", "pack_map", "quantised"]

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


def quantised(disparity: npt.NDArray[np.float32]) -> npt.NDArray[np.uint16]:
    """Disparity in steps of 1/64 px, plus 1; 0 where unknown. Values are held within 0 to 1023.9 px."""
    known = np.isfinite(disparity)
    codes = np.rint(np.where(known, disparity, 0).clip(0, 65534 / DISPARITY_STEPS) * DISPARITY_STEPS) + 1
    return np.where(known, codes, 0).clip(0, 65535).astype(np.uint16)


def _text(content: bytes) -> str:
    return base64.b64encode(zlib.compress(content, 9)).decode()
