"""Booster: large indoor pictures with glass and mirrors, ground truth by painting the scenes over."""

from pathlib import Path

import numpy as np

from stereokit.data.datasets.dataset import DATASETS, Mask, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import check_choice, first_folder, image_names, list_folder, make_dataset
from stereokit.data.disparity_arrays import PathLike
from stereokit.data.images import first_channel, read_samples
from stereokit.data.npy import read_npy

__all__ = ["booster"]


@DATASETS.register("booster")
def booster(root: PathLike, *, split: str = "train") -> StereoDataset:
    """Booster, balanced: 228 training and 191 test pairs of 4112 x 3008, each scene under several lights.

    Views of one light have the same file name. The unbalanced pairs, whose cameras differ, are not read, nor the
    calibration, which is OpenCV's XML. That all pictures of a scene share `disp_00.npy` and `mask_00.png` is how
    published loaders read them.

    Args:
        root: holds `train/balanced/Bathroom/camera_00/im0.png`, `camera_02/im0.png`, `disp_00.npy` and `mask_00.png`,
            and `test/balanced`, which has no ground truth.
        split: "train" or "test".

    Raises:
        InputError: another tree, or an unknown split.

    Source: Zama Ramirez et al., Open challenges in deep stereo: the Booster dataset, CVPR 2022.
    """
    root = Path(root)
    check_choice("split", split, ("train", "test"))
    folder = first_folder([root / split / "balanced", root / "Booster" / split / "balanced"])
    entries = [
        StereoEntry(
            name=f"{scene.name}/{Path(name).stem}",
            left=scene / "camera_00" / name,
            right=scene / "camera_02" / name,
            disparity=Source(scene / "disp_00.npy", read_npy) if split == "train" else None,
            nonocc=Source.optional(scene / "mask_00.png", _read_mask),
            right_disparity=Source.optional(scene / "disp_02.npy", read_npy),
            right_nonocc=Source.optional(scene / "mask_02.png", _read_mask),
        )
        for scene in (list_folder(folder) if folder else [])
        for name in image_names(scene / "camera_00", scene / "camera_02")
    ]
    expected = [f"{split}/balanced/Bathroom/camera_00/im0.png"]
    return make_dataset("booster", root, split, entries, expected=expected)


def _read_mask(path: Path) -> Mask:
    samples = read_samples(path)
    mask: Mask = first_channel(samples) > np.iinfo(samples.dtype).max // 2
    return mask
