"""The geometry of a rectified pair: what turns disparity into depth, and pixels into rays."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from stereokit.calibration.versioned import check_version, is_count, read_number
from stereokit.errors import InputError
from stereokit.files import write_json

__all__ = ["FORMAT", "VERSION", "Calibration", "PathLike"]

PathLike: TypeAlias = "str | os.PathLike[str]"

FORMAT = "stereokit calibration"
"""What the library's own files say that they are."""

VERSION = 1
"""Of the library's own files."""


@dataclass(frozen=True)
class Calibration:
    """A rectified pair of cameras.

    Lengths are in metres. Pixel centres lie at whole numbers. The axes are those of OpenCV, in the left camera: x to
    the right, y down, z forward along the optical axis. A point (X, Y, Z) is seen at

        x_left = cx0 + fx X / Z,    y = cy + fy Y / Z,    x_right = cx1 + fx (X - baseline) / Z.

    Attributes:
        fx: focal length in pixels along the rows, of both views.
        baseline: distance of the cameras in metres.
        cx0: column of the principal point in the left view, in pixels.
        cx1: the same in the right view.
        width: of the images in pixels, or None where the file does not say.
        height: the same.
        fy: focal length in pixels along the columns; `fx` where it is left out.
        cy: row of the principal point, of both views, or None where it is not known. Point clouds need it.

    Raises:
        InputError: a focal length or baseline that is not positive, a value that is not finite, or one of width and
            height without the other.

    >>> camera = Calibration(fx=700.0, baseline=0.5, cx0=320.0, cx1=320.0, width=640, height=480)
    >>> float(camera.depth(10.0))
    35.0
    """

    fx: float
    baseline: float
    cx0: float
    cx1: float
    width: int | None = None
    height: int | None = None
    fy: float = math.nan
    cy: float | None = None

    def __post_init__(self) -> None:
        if math.isnan(self.fy):
            object.__setattr__(self, "fy", self.fx)
        for focal in (self.fx, self.fy):
            if not (math.isfinite(focal) and focal > 0):
                raise InputError(f"calibration: the focal length must be a positive number of pixels, got {focal}")
        if not (math.isfinite(self.baseline) and self.baseline > 0):
            raise InputError(
                f"calibration: the baseline must be a positive number of metres, got {self.baseline}; "
                "a negative one means that the views are swapped"
            )
        if not all(map(math.isfinite, (self.cx0, self.cx1, self.cy or 0))):
            raise InputError(
                f"calibration: the principal points must be finite, got {self.cx0}, {self.cx1} and {self.cy}"
            )
        if (self.width is None) != (self.height is None):
            raise InputError(f"calibration: the image size must be both sides or neither, got {self._size_text}")
        if self.width is not None and self.height is not None and min(self.width, self.height) < 1:
            raise InputError(f"calibration: the image size must be positive, got {self._size_text}")

    @property
    def doffs(self) -> float:
        """`cx1 - cx0`, which Middlebury calls doffs: minus the disparity of what is infinitely far."""
        return self.cx1 - self.cx0

    def depth(self, disparity: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Depth along the optical axis, Z = baseline fx / (d + cx1 - cx0). It is not the distance from the camera.

        Args:
            disparity: of any shape, in pixels at the resolution of this calibration.

        Returns:
            Metres, of the same shape. NaN where the disparity is unknown (NaN, infinite, or 0 and no
            offset) and where it would lie behind the camera.

        Source: Middlebury stereo 2014, description of the calibration file.
        """
        return self._reciprocal(np.asarray(disparity, np.float64) + self.doffs)

    def disparity(self, depth: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """The inverse of `depth`: d = baseline fx / Z - (cx1 - cx0).

        Args:
            depth: of any shape, in metres along the optical axis.

        Returns:
            Pixels, of the same shape. NaN where the depth is unknown (NaN, infinite) or not positive.

        >>> float(Calibration(fx=700.0, baseline=0.5, cx0=320.0, cx1=325.0).disparity(35.0))
        5.0
        """
        shift = self._reciprocal(np.asarray(depth, np.float64), np.float64)
        return (shift - self.doffs).astype(np.float32)

    def check_size(self, height: int, width: int) -> None:
        """Refuses images of another size than this calibration is for; with none in it, it fits all.

        Raises:
            InputError: the sizes differ.

        >>> Calibration(1400.0, 0.1, 128.0, 128.0, width=256, height=128).check_size(64, 128)
        Traceback (most recent call last):
        ...
        stereokit.errors.InputError: the calibration is for images of 256 x 128 pixels, these have 128 x 64; ...
        """
        if self.width is None or self.height is None or (self.height, self.width) == (height, width):
            return
        if self._same_aspect(height, width):
            hint = (
                f"if they were resized, use calibration.scaled(height={height}, width={width}), or "
                f"'stereokit calibrate convert FILE NEW --scale-to {height} {width}'"
            )
        else:
            hint = "they have another aspect ratio, so they were cropped, or belong to another camera"
        raise InputError(
            f"the calibration is for images of {self._size_text} pixels, these have {width} x {height}; {hint}"
        )

    def sized(self, height: int, width: int) -> "Calibration":
        """The same calibration with the size of its images, which some files do not say.

        Raises:
            InputError: it is for another size.

        >>> Calibration(700.0, 0.5, 320.0, 320.0).sized(480, 640).height
        480
        """
        self.check_size(height, width)
        return replace(self, height=height, width=width)

    def scaled(self, *, height: int, width: int, stretch: bool = False) -> "Calibration":
        """The calibration of the images resized.

        With s the ratio of the widths, or of the heights: f' = s f and c' = (c + 0.5) s - 0.5, because the border of
        the first pixel, at -0.5, stays where it is. Disparity is multiplied by the ratio of the widths.

        Args:
            height: of the resized images.
            width: likewise.
            stretch: allow another aspect ratio, of images that were stretched. Most images of another ratio were
                cropped instead, see `cropped`.

        Raises:
            InputError: the size of this calibration is not known, see `sized`; a size that is not positive; or another
                aspect ratio, by more than rounding.

        >>> Calibration(1400.0, 0.1, 128.0, 128.0, width=256, height=128).scaled(height=64, width=128)
        Calibration(fx=700.0, baseline=0.1, cx0=63.75, cx1=63.75, width=128, height=64, fy=700.0, cy=None)
        """
        old_height, old_width = self._known_size()
        if height < 1 or width < 1:
            raise InputError(f"calibration: images can't be scaled to {width} x {height} pixels")
        if not stretch and not self._same_aspect(height, width):
            raise InputError(
                f"calibration: {width} x {height} has another aspect ratio than {self._size_text}; use cropped() if "
                "the images were cropped, or stretch=True if they were stretched"
            )
        across, down = width / old_width, height / old_height
        return replace(
            self,
            fx=self.fx * across,
            fy=self.fy * down,
            cx0=(self.cx0 + 0.5) * across - 0.5,
            cx1=(self.cx1 + 0.5) * across - 0.5,
            cy=None if self.cy is None else (self.cy + 0.5) * down - 0.5,
            width=width,
            height=height,
        )

    def cropped(
        self, *, top: int, left: int, height: int, width: int, left_of_right: int | None = None
    ) -> "Calibration":
        """The calibration of a window of the images.

        Args:
            top: first row of the window.
            left: its first column in the left view.
            height: of the window.
            width: of the window.
            left_of_right: its first column in the right view; `left` where it is left out. Disparity grows by
                `left_of_right - left`, depth stays as it is.

        Raises:
            InputError: the window does not lie within the images, where their size is known, or is empty.

        >>> toed_in = Calibration(700.0, 0.5, 320.0, 320.0, width=640, height=480)
        >>> moved = toed_in.cropped(top=0, left=0, left_of_right=8, height=480, width=632)
        >>> bool(moved.depth(28.0) == toed_in.depth(20.0))
        True
        """
        left_of_right = left if left_of_right is None else left_of_right
        first, last = min(left, left_of_right), max(left, left_of_right) + width
        rows, columns = (math.inf if side is None else side for side in (self.height, self.width))
        if min(top, first) < 0 or height < 1 or width < 1 or top + height > rows or last > columns:
            raise InputError(
                f"calibration: a window of {width} x {height} at ({first}, {top}) does not lie within "
                f"{self._size_text} pixels"
            )
        return replace(
            self,
            cx0=self.cx0 - left,
            cx1=self.cx1 - left_of_right,
            cy=None if self.cy is None else self.cy - top,
            width=width,
            height=height,
        )

    def mirrored(self) -> "Calibration":
        """The calibration of the pair in a mirror: the right view flipped is the left one, the left view flipped the
        right one.

        Raises:
            InputError: the size of this calibration is not known, see `sized`.

        >>> camera = Calibration(700.0, 0.5, 320.0, 325.0, width=640, height=480).mirrored()
        >>> camera.cx0, camera.cx1
        (314.0, 319.0)
        """
        _, width = self._known_size()
        return replace(self, cx0=width - 1 - self.cx1, cx1=width - 1 - self.cx0)

    def known_cy(self) -> float:
        """`cy`, where it is known.

        Raises:
            InputError: it is not.
        """
        if self.cy is None:
            raise InputError("the calibration does not say cy, the row of the principal point, which is needed here")
        return self.cy

    def to_dict(self) -> dict[str, Any]:
        """What `write` puts into a file; `from_dict` takes it."""
        size = None if self.width is None else [self.width, self.height]
        values = {key: getattr(self, key) for key in ("fx", "fy", "cx0", "cx1", "cy", "baseline")}
        return {"format": FORMAT, "version": VERSION, "unit": "metre", "image_size": size, **values}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Calibration":
        """A calibration from what `to_dict` gives. Entries that it does not know are passed over.

        Raises:
            InputError: another format, a version from the future, or missing or malformed entries.

        >>> camera = Calibration(700.0, 0.5, 320.0, 320.0, width=640, height=480, cy=240.0)
        >>> Calibration.from_dict(camera.to_dict()) == camera
        True
        """
        check_version(values, FORMAT, VERSION)
        numbers: dict[str, float] = {}
        for key in ("fx", "fy", "cx0", "cx1", "baseline"):
            numbers[key] = read_number(values, key)
        size = values.get("image_size")
        if size is not None and not (isinstance(size, list) and len(size) == 2 and all(map(is_count, size))):
            raise InputError(f"expected image_size as [width, height] or null, got {str(size)[:80]}")
        width, height = size or (None, None)
        cy = None if values.get("cy") is None else read_number(values, "cy")
        return cls(**numbers, cy=cy, width=width, height=height)

    def write(self, path: PathLike, *, overwrite: bool = False) -> None:
        """Writes the calibration as the library's own JSON; `write_calibration` writes other formats.

        Raises:
            InputError: another suffix than .json, an existing file, or one that can't be written.
        """
        if Path(path).suffix.lower() != ".json":
            raise InputError(
                f"{os.fspath(path)!r}: Calibration.write makes the library's own .json; use write_calibration for "
                "other formats"
            )
        write_json(path, self.to_dict(), overwrite=overwrite)

    @property
    def _size_text(self) -> str:
        return f"{self.width} x {self.height}"

    def _known_size(self) -> tuple[int, int]:
        if self.height is None or self.width is None:
            raise InputError("the calibration does not say the size of its images; use sized(height, width) first")
        return self.height, self.width

    def _same_aspect(self, height: int, width: int) -> bool:
        """Whether one factor gives both sides, each of them rounded."""
        old_height, old_width = self._known_size()
        return abs(width / old_width - height / old_height) < 1 / old_width + 1 / old_height

    def _reciprocal(
        self, values: npt.NDArray[np.float64], dtype: type[np.floating[Any]] = np.float32
    ) -> npt.NDArray[Any]:
        """Baseline fx / values; NaN where these are unknown, not positive, or too small for a float32 result."""
        least = self.baseline * self.fx / float(np.finfo(np.float32).max)
        known = np.isfinite(values) & (values > least)
        result = np.full(values.shape, np.nan)
        np.divide(self.baseline * self.fx, values, out=result, where=known)
        return result.astype(dtype)
