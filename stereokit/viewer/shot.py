"""One matched pair, and what of it goes to the page."""

import io
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.inference import DisparityResult
from stereokit.viewer.packing import DISPARITY_STEPS, FINE_STEPS, quantised, with_head

__all__ = ["Image", "Shot", "encode_image"]

Image: TypeAlias = npt.NDArray[np.uint8]
"""(H, W, 3), RGB."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One matched pair.

    Args:
        number: by which the page asks for it.
        name: of the pair, or of the frame.
        left: (H, W, 3), RGB.
        right: likewise.
        result: its disparity.
        lossless: whether the images go to the page as PNG; else as JPEG, which is faster.
    """

    number: int
    name: str
    left: Image
    right: Image
    result: DisparityResult
    lossless: bool = True

    def facts(self) -> dict[str, Any]:
        """What the page has to know before it asks for images and arrays, in plain JSON."""
        height, width = self.result.size
        confidence = self.result.confidence
        return {
            "number": self.number,
            "name": self.name,
            "width": width,
            "height": height,
            "seconds": None if np.isnan(self.result.seconds) else self.result.seconds,
            "confidence": None if confidence is None else float(np.nanmean(confidence)),
        }

    def disparity_bytes(self) -> bytes:
        """float32, little-endian, row by row; NaN where unknown."""
        disparity = self.result.disparity.astype("<f4")
        disparity[~np.isfinite(disparity)] = np.nan
        return disparity.tobytes()

    def confidence_bytes(self) -> bytes | None:
        """uint16, little-endian, row by row; 65535 stands for 1."""
        if self.result.confidence is None:
            return None
        return np.rint(np.nan_to_num(self.result.confidence) * 65535).astype("<u2").tobytes()

    def packed(self) -> bytes:
        """All of it in one answer, for streams: a head in JSON, the disparity in whole steps plus 1 (uint16; 0 where
        unknown), the confidence in steps of 1/255 (uint8), and both images.

        The head's length comes first, in four bytes; all numbers are little-endian. The head says the length of each
        part, and how many steps a pixel of disparity has.
        """
        known = self.result.known_range
        steps = FINE_STEPS if known is None or known[1] < 65534 / FINE_STEPS else DISPARITY_STEPS
        confidence = self.result.confidence
        levels = None if confidence is None else (np.nan_to_num(confidence) * 255 + 0.5).astype(np.uint8)
        parts = {
            "disparity": quantised(self.result.disparity, steps).astype("<u2").tobytes(),
            "confidence": b"" if levels is None else levels.tobytes(),
            "left": self.image_bytes("left")[0],
            "right": self.image_bytes("right")[0],
        }
        facts = {**self.facts(), "steps": steps, "parts": {name: len(part) for name, part in parts.items()}}
        return with_head(facts, *parts.values())

    def image_bytes(self, view: str) -> tuple[bytes, str]:
        """The view "left" or "right" as a file, and its type."""
        image = self.left if view == "left" else self.right
        return encode_image(image, ".png" if self.lossless else ".jpg")

    def archive(self, more: Mapping[str, bytes]) -> bytes:
        """A zip of both images and the disparity, which `stereokit view` opens again.

        Args:
            more: further files.
        """
        arrays: dict[str, Any] = {"disparity": self.result.disparity}
        if self.result.confidence is not None:
            arrays["confidence"] = self.result.confidence
        held = io.BytesIO()
        np.savez_compressed(held, **arrays)
        files = {
            "left.png": encode_image(self.left, ".png")[0],
            "right.png": encode_image(self.right, ".png")[0],
            "left_disparity.npz": held.getvalue(),
            **more,
        }
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for name, content in files.items():
                # without the time of the day, so that the same frame gives the same file
                archive.writestr(zipfile.ZipInfo(name), content)
        return packed.getvalue()


def encode_image(image: Image, suffix: str) -> tuple[bytes, str]:
    """An image as PNG or JPEG, and its type."""
    settings = {".png": [cv2.IMWRITE_PNG_COMPRESSION, 1], ".jpg": [cv2.IMWRITE_JPEG_QUALITY, 92]}[suffix]
    _, encoded = cv2.imencode(suffix, np.ascontiguousarray(image[:, :, ::-1]), settings)
    return encoded.tobytes(), "image/png" if suffix == ".png" else "image/jpeg"
