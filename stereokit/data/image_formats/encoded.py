"""What an image file says of itself, known before anything is decoded."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

__all__ = ["EncodedImage", "Samples", "decode_with_opencv"]

Samples: TypeAlias = npt.NDArray[Any]
"""(H, W) or RGB(A) (H, W, 3 or 4), of the type that is stored."""


@dataclass(frozen=True)
class EncodedImage:
    """An image before it is decoded.

    Attributes:
        format: "PNG", "JPEG", "PNM", "BMP", "WebP" or "TIFF".
        width: in pixels.
        height: in pixels.
        channels: of the decoded image, at most.
        sample_bytes: of one decoded sample.
        decode: gives the stored samples; raises ValueError where they are damaged.
        copies: how often the samples are in memory while they are decoded, at most.
        peak: the sample value that stands for white where the file names one (PNM), else None for the full range.
    """

    format: str
    width: int
    height: int
    channels: int
    sample_bytes: int
    decode: Callable[[], Samples] = field(compare=False, repr=False)
    copies: int = 2
    peak: int | None = None

    def memory(self, result_bytes: int) -> int:
        """What decoding takes at most, in bytes, with a result of so many bytes per pixel."""
        return self.width * self.height * (self.copies * self.channels * self.sample_bytes + result_bytes)


def decode_with_opencv(data: bytes) -> Samples:
    """Decodes a file with OpenCV, without any conversion but that of BGR to RGB.

    Raises:
        ValueError: the data is damaged.
    """
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        decoded = None
    if decoded is None:
        raise ValueError("its data can't be decoded")
    if decoded.ndim == 2:
        return decoded
    # a view; alpha stays where it is
    return decoded[:, :, ::-1] if decoded.shape[2] == 3 else decoded[:, :, [2, 1, 0, 3]]
