"""Spring: an animated film, rendered, with ground truth of twice the size of its images."""

import importlib
import os
from pathlib import Path

import numpy as np

from stereokit.data.datasets.dataset import DATASETS, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import check_choice, first_folder, images_in, list_folder, make_dataset
from stereokit.data.disparity_arrays import Disparity, PathLike, check_claimed_size, unknown_to_nan
from stereokit.errors import InputError, printable
from stereokit.files import read_file_bytes

__all__ = ["read_spring_disparity", "spring"]


@DATASETS.register("spring")
def spring(root: PathLike, *, split: str = "train") -> StereoDataset:
    """Spring: 5000 training and 1000 test pairs of 1920 x 1080.

    Reading its ground truth needs h5py (`pip install 'stereokit[spring]'`). Its calibration is not read.

    Args:
        root: holds `train/0001/frame_left/frame_left_0001.png`, `frame_right`, `disp1_left/disp1_left_0001.dsp5` and
            `disp1_right`, and `test`, which has no ground truth; or a folder `spring` that does.
        split: "train" or "test".

    Raises:
        InputError: another tree, or an unknown split.

    Source: Mehl et al., Spring: a high-resolution high-detail dataset and benchmark for scene flow, optical flow and
    stereo, CVPR 2023; the tools of its authors.
    """
    root = Path(root)
    check_choice("split", split, ("train", "test"))
    folder = first_folder([root / split, root / "spring" / split])
    entries = [
        _entry(scene, number)
        for scene in (list_folder(folder) if folder else [])
        for number in sorted({name.stem.rpartition("_")[2] for name in _frames(scene)})
    ]
    return make_dataset("spring", root, split, entries, expected=[f"{split}/0001/frame_left/frame_left_0001.png"])


def read_spring_disparity(path: PathLike) -> Disparity:
    """Reads Spring's disparity, HDF5 with one data set "disparity", at the size of the images.

    It is stored at twice that size, in pixels of the images: every other row and column is taken.

    Returns:
        (H, W) float32, NaN where it is not finite.

    Raises:
        InputError: h5py is not installed, or a missing or broken file.
    """
    read_file_bytes(path, 0)  # whether it is a file
    try:
        h5py = importlib.import_module("h5py")
    except ImportError as error:
        raise InputError(
            f"{printable(path)} is HDF5, which the package h5py reads; pip install 'stereokit[spring]' installs it"
        ) from error
    try:
        with h5py.File(os.fspath(path), "r") as file:
            stored = file["disparity"]
            if len(stored.shape) != 2 or stored.dtype.kind != "f":
                raise InputError(f"{printable(path)} holds {stored.dtype} of shape {stored.shape}; expected disparity")
            check_claimed_size(path, stored.shape, stored.dtype.itemsize)
            return unknown_to_nan(np.asarray(stored[()])[::2, ::2])
    except (OSError, KeyError, AttributeError, ValueError, RuntimeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{printable(path)} is no HDF5 file with a data set 'disparity', or a broken one") from error


def _frames(scene: Path) -> list[Path]:
    return [path for side in ("left", "right") for path in images_in(scene / f"frame_{side}")]


def _entry(scene: Path, number: str) -> StereoEntry:
    right_truth = scene / "disp1_right" / f"disp1_right_{number}.dsp5"
    return StereoEntry(
        name=f"{scene.name}/{number}",
        left=scene / "frame_left" / f"frame_left_{number}.png",
        right=scene / "frame_right" / f"frame_right_{number}.png",
        disparity=Source.within(scene / "disp1_left", f"disp1_left_{number}.dsp5", read_spring_disparity),
        right_disparity=Source.optional(right_truth, read_spring_disparity),
    )
