"""What every data set of stereo pairs is: a sequence of `StereoSample`, each read when it is asked for."""

import copy
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

import numpy as np
import numpy.typing as npt

from stereokit.calibration.rectified import Calibration
from stereokit.data.bit_depth import warn_of_other_depths
from stereokit.data.disparity_arrays import Disparity
from stereokit.data.images import read_image
from stereokit.errors import InputError, printable
from stereokit.registry import Registry

__all__ = ["DATASETS", "Mask", "Source", "StereoDataset", "StereoEntry", "StereoSample"]

DATASETS = Registry("datasets", kind="data set")
"""The kinds of data set by name. Each entry is called with `root`, and with `split` and its own options."""

Mask = npt.NDArray[np.bool_]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class StereoSample:
    """A rectified pair and what is known about it, with x_right = x_left - disparity.

    Attributes:
        name: of the pair, unique in its data set.
        left: RGB, (H, W, 3), uint8 or float32 in [0, 1].
        right: the same, of the same size.
        disparity: (H, W) float32 in pixels of the left image, NaN where unknown. None without ground truth.
        nonocc: (H, W) bool, True where the left pixel is seen by the right camera too. None where that is
            unknown.
        objects: (H, W) uint8, 0 for the background and a number for each foreground object (KITTI 2015). None
            without such a map.
        calibration: of the pair, at this size. None where it is unknown.
        right_disparity: the right view's own ground truth, (H, W) float32, NaN where unknown: the match of the right
            pixel in column x lies in column x + d of the left view. None without it.
        right_nonocc: (H, W) bool, True where the right pixel is seen by the left camera too. None where that is
            unknown.
        assumed_scale: the stored value of one pixel of disparity that was taken for granted, because neither the file
            nor the caller named it. None where nothing was.

    Raises:
        InputError: the parts are not of one size, or are no images and maps.
    """

    name: str
    left: npt.NDArray[Any]
    right: npt.NDArray[Any]
    disparity: Disparity | None = None
    nonocc: Mask | None = None
    objects: npt.NDArray[np.uint8] | None = None
    calibration: Calibration | None = None
    right_disparity: Disparity | None = None
    right_nonocc: Mask | None = None
    assumed_scale: float | None = None

    def __post_init__(self) -> None:
        name = f"pair {printable(self.name, most=80)}"
        for view, image in (("left", self.left), ("right", self.right)):
            if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
                raise InputError(f"{name}: the {view} image has shape {image.shape}; expected (H, W, 3)")
        height, width = self.left.shape[:2]
        parts = {
            "right image": self.right,
            "ground truth": self.disparity,
            "non-occluded mask": self.nonocc,
            "object map": self.objects,
            "right view's ground truth": self.right_disparity,
            "right view's non-occluded mask": self.right_nonocc,
        }
        for part, values in parts.items():
            if values is None:
                continue
            if part != "right image" and values.ndim != 2:
                raise InputError(f"{name}: the {part} has shape {values.shape}; expected (H, W)")
            if values.shape[:2] != (height, width):
                raise InputError(
                    f"{name}: the {part} is {values.shape[1]} x {values.shape[0]} pixels, "
                    f"the left image {width} x {height}; expected one size"
                )
        camera = self.calibration
        if camera is not None and (camera.width or width, camera.height or height) != (width, height):
            raise InputError(
                f"{name}: the calibration is of images of {camera.width} x {camera.height} pixels, the left image is "
                f"{width} x {height}; give that of this size: depth would be off by the ratio"
            )


@dataclass(frozen=True)
class Source(Generic[T]):
    """A file and the function that reads it."""

    path: Path
    read: Callable[[Path], T]

    def __call__(self) -> T:
        """Reads the file."""
        return self.read(self.path)

    @classmethod
    def within(cls, folder: Path, name: str, read: Callable[[Path], T]) -> "Source[T] | None":
        """A file of a folder, or None where the folder is not there: that part of the data was not fetched.

        Where the folder is there, a missing file is an error, found by `StereoDataset.missing_files`.
        """
        return cls(folder / name, read) if folder.is_dir() else None

    @classmethod
    def optional(cls, path: Path, read: Callable[[Path], T]) -> "Source[T] | None":
        """A file, or None where it is not there: data that the pair can do without."""
        return cls(path, read) if path.is_file() else None


@dataclass(frozen=True)
class StereoEntry:
    """Where the parts of a `StereoSample` lie, and the bits of the cameras where its images name more."""

    name: str
    left: Path
    right: Path
    disparity: Source[Disparity] | None = None
    nonocc: Source[Mask] | None = None
    objects: Source[npt.NDArray[np.uint8]] | None = None
    calibration: Source[Calibration] | Calibration | None = None
    right_disparity: Source[Disparity] | None = None
    right_nonocc: Source[Mask] | None = None
    assumed_scale: Source[float | None] | None = None
    bit_depth: int | None = None

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files that the entry names."""
        sources = (
            self.disparity,
            self.nonocc,
            self.objects,
            self.calibration,
            self.right_disparity,
            self.right_nonocc,
        )
        return (self.left, self.right, *(source.path for source in sources if isinstance(source, Source)))

    def read(self) -> StereoSample:
        """Reads the pair.

        Raises:
            InputError: a missing or broken file, or parts of different sizes.

        Warns:
            UserWarning: a scale of ground truth had to be assumed, or the images do not use their bits (see
                `read_image`).
        """
        left, right = (read_image(path, bit_depth=self.bit_depth) for path in (self.left, self.right))
        warn_of_other_depths(left, right)
        assumed = self.assumed_scale() if self.assumed_scale else None
        if assumed is not None:
            warnings.warn(
                f"ground truth that does not name its scale is taken to hold {assumed:g} for a pixel of disparity: if "
                f"that is right, say so (scale={assumed:g}), else give the right one",
                stacklevel=2,
            )
        return StereoSample(
            name=self.name,
            left=left,
            right=right,
            disparity=self.disparity() if self.disparity else None,
            nonocc=self.nonocc() if self.nonocc else None,
            objects=self.objects() if self.objects else None,
            calibration=self.calibration() if isinstance(self.calibration, Source) else self.calibration,
            right_disparity=self.right_disparity() if self.right_disparity else None,
            right_nonocc=self.right_nonocc() if self.right_nonocc else None,
            assumed_scale=assumed,
        )


class StereoDataset(Sequence[StereoSample]):
    """A sequence of stereo pairs, read from disk one at a time.

    It is what `torch.utils.data.DataLoader` takes for a map-style data set, and can be sent to its workers. A
    slice is a data set of fewer pairs.

    Args:
        kind: the name of the kind, such as "kitti2012".
        root: the folder or file that it was opened with.
        split: which part of it this is.
        entries: where the pairs lie.
        passed_over: folders that hold images, and that the kind can make no pair of.
        unused_truth: files that look like ground truth, and are none by the kind's rules.
    """

    def __init__(
        self,
        kind: str,
        root: Path,
        split: str,
        entries: Sequence[StereoEntry],
        *,
        passed_over: Sequence[str] = (),
        unused_truth: Sequence[str] = (),
    ) -> None:
        self.kind = kind
        self.root = root
        self.split = split
        self.entries = tuple(entries)
        self.passed_over = tuple(passed_over)
        self.unused_truth = tuple(unused_truth)

    def __len__(self) -> int:
        return len(self.entries)

    @overload
    def __getitem__(self, index: int) -> StereoSample: ...

    @overload
    def __getitem__(self, index: slice) -> "StereoDataset": ...

    def __getitem__(self, index: int | slice) -> "StereoSample | StereoDataset":
        if isinstance(index, slice):
            part = copy.copy(self)
            part.entries = self.entries[index]
            return part
        return self.entries[index].read()

    def __iter__(self) -> Iterator[StereoSample]:
        return (entry.read() for entry in self.entries)

    def __repr__(self) -> str:
        return f"StereoDataset({self.kind!r}, {os.fspath(self.root)!r}, split={self.split!r}, {len(self)} pairs)"

    def missing_files(self) -> list[Path]:
        """The files of the data set that are not there."""
        return [path for entry in self.entries for path in entry.paths if not os.path.isfile(path)]
