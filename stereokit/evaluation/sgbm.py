"""The classical rival: OpenCV's semi-global block matcher."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from stereokit.data.disparity_arrays import Disparity
from stereokit.data.images import to_uint8
from stereokit.errors import ConfigError, InputError
from stereokit.evaluation.matcher import Image
from stereokit.inference.shifting import checked_min_disparity

__all__ = ["SGBM_VARIANTS", "SemiGlobalMatcher", "fill_from_background"]

CHANNELS = 3
P1_FACTOR, P2_FACTOR = 8, 32
SUBPIXELS = 16


@dataclass(frozen=True)
class SemiGlobalMatcher:
    """OpenCV's semi-global block matcher, on colour images.

    Along straight paths it minimises the sum of a Birchfield-Tomasi block cost and a price for each step of disparity
    between neighbours: P1 = 8 C b² for a step of 1 px and P2 = 32 C b² for a larger one, with C = 3 channels and blocks
    of b x b pixels, as OpenCV's documentation suggests. An estimate is kept if its cost is 10 % below the next best, if
    it agrees with the right view's to 1 px, and if it lies in a region of at least 100 pixels that vary by at most 2 px
    between neighbours; gradients are clipped at 63. OpenCV takes 8-bit images: those of 16 bits are rounded.

    OpenCV leaves out the left `search_range` columns; here the images are padded on the left before and cut after, so
    that every disparity is looked for in every column.

    Args:
        paths: 8 (`MODE_HH`, the full algorithm, which needs memory for all costs) or 5 (`MODE_SGBM`, one pass).
        fill: whether holes are filled, see `fill_from_background`; otherwise they are NaN.
        search_range: disparities 0 <= d < search_range are tried; is rounded up to a multiple of 16.
        block_size: b, odd.
        min_disparity: m, a whole number of pixels; m <= d < m + search_range are tried then.

    Raises:
        ConfigError: arguments outside these values.

    Source: Hirschmüller, Stereo processing by semiglobal matching and mutual information, PAMI 2008;
    `cv::StereoSGBM`.

    >>> rng = np.random.default_rng(0)
    >>> right = rng.integers(0, 256, (40, 90, 3), dtype=np.uint8)
    >>> left = np.roll(right, 7, axis=1)
    >>> float(np.median(SemiGlobalMatcher(search_range=32)(left, right)))
    7.0
    """

    paths: Literal[5, 8] = 8
    fill: bool = True
    search_range: int = 192
    block_size: int = 3
    min_disparity: int = 0

    def __post_init__(self) -> None:
        if self.paths not in (5, 8):
            raise ConfigError(f"paths is {self.paths}; OpenCV's semi-global matcher has 5 or 8")
        if self.search_range < 1:
            raise ConfigError(f"search_range is {self.search_range}; expected at least 1 px")
        checked_min_disparity(self.min_disparity)
        if self.block_size < 1 or self.block_size % 2 == 0:
            raise ConfigError(f"block_size is {self.block_size}; expected an odd number of pixels, such as 3 or 5")

    def __call__(self, left: Image, right: Image) -> Disparity:
        """Matches one pair.

        Args:
            left: (H, W, 3), uint8 or floating-point in [0, 1].
            right: likewise, of the same size.

        Returns:
            (H, W) float32, in steps of 1/16 px; NaN in holes.

        Raises:
            InputError: images of different sizes.
        """
        if left.shape != right.shape:
            raise InputError(f"the left image has shape {left.shape}, the right one {right.shape}; expected one shape")
        levels = -(-self.search_range // 16) * 16
        # OpenCV leaves out columns on the right too where disparities may be negative
        before, after = levels + max(self.min_disparity, 0), max(-self.min_disparity, 0)
        width = left.shape[1]
        views = [
            cv2.copyMakeBorder(to_uint8(view), 0, 0, before, after, cv2.BORDER_REPLICATE) for view in (left, right)
        ]
        area = CHANNELS * self.block_size**2
        matcher = cv2.StereoSGBM.create(
            minDisparity=self.min_disparity,
            numDisparities=levels,
            blockSize=self.block_size,
            P1=P1_FACTOR * area,
            P2=P2_FACTOR * area,
            disp12MaxDiff=1,
            preFilterCap=63,
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_HH if self.paths == 8 else cv2.STEREO_SGBM_MODE_SGBM,
        )
        steps = matcher.compute(*views)[:, before : before + width]
        # what OpenCV finds no match for is one step below the range
        disparity = np.where(steps < self.min_disparity * SUBPIXELS, np.nan, steps / np.float32(SUBPIXELS)).astype(
            np.float32
        )
        return fill_from_background(disparity) if self.fill else disparity

    def describe(self) -> dict[str, Any]:
        """The parameters, in plain JSON."""
        name = f"OpenCV StereoSGBM, {self.paths} paths, holes {'filled' if self.fill else 'left'}"
        return {"matcher": name, "device": "cpu", **asdict(self)}


SGBM_VARIANTS: dict[str, SemiGlobalMatcher] = {
    "sgbm": SemiGlobalMatcher(paths=8, fill=True),
    "sgbm_unfilled": SemiGlobalMatcher(paths=8, fill=False),
    "sgbm_5paths": SemiGlobalMatcher(paths=5, fill=True),
    "sgbm_5paths_unfilled": SemiGlobalMatcher(paths=5, fill=False),
}
"""The variants that `stereokit eval --model` knows, by name."""


def fill_from_background(disparity: npt.NDArray[np.floating[Any]]) -> Disparity:
    """Fills holes with the smaller, farther one of the nearest estimates to their left and right in the row.

    A hole is mostly a part of the background that the right camera does not see. At the border the one neighbour there
    is does. A row of holes alone takes the nearest row; a map of holes alone stays one.

    Args:
        disparity: (H, W), in pixels, not finite in holes.

    >>> fill_from_background(np.array([[np.nan, 9, np.nan, np.nan, 4, np.nan]])).tolist()
    [[9.0, 9.0, 4.0, 4.0, 4.0, 4.0]]
    """
    filled = np.where(np.isfinite(disparity), disparity, np.nan).astype(np.float32)
    filled = np.fmin(_carried(filled), _carried(filled[:, ::-1])[:, ::-1])
    known = np.flatnonzero(np.isfinite(filled[:, 0]))
    if known.size:
        rows = np.arange(len(filled))
        nearest = known[np.abs(rows[:, None] - known).argmin(axis=1)]
        filled = filled[nearest]
    return filled


def _carried(disparity: Disparity) -> Disparity:
    """Each value, or else the last one before it in its row."""
    columns = np.where(np.isfinite(disparity), np.arange(disparity.shape[1]), 0)
    last: Disparity = np.take_along_axis(disparity, np.maximum.accumulate(columns, axis=1), axis=1)
    return last
