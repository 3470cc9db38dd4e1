"""Virtual KITTI 2: five drives of KITTI rendered anew, in many weathers, with dense depth for both views."""

from pathlib import Path

import numpy as np

from stereokit.calibration import Calibration
from stereokit.data.datasets.dataset import DATASETS, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import check_choice, first_folder, image_names, list_folder, make_dataset
from stereokit.data.disparity_arrays import Disparity, PathLike
from stereokit.data.images import read_samples
from stereokit.errors import InputError, printable

__all__ = ["virtual_kitti2"]

_CAMERA = Calibration(fx=725.0087, baseline=0.532725, cx0=620.5, cx1=620.5, width=1242, height=375)
_FARTHEST = 65535


@DATASETS.register("virtual_kitti2")
def virtual_kitti2(root: PathLike, *, split: str = "all", variation: str = "all") -> StereoDataset:
    """Virtual KITTI 2: 21260 pairs of 1242 x 375.

    Disparity is computed from the depth, which is stored in centimetres in 16 bits: d = 725.0087 * 53.2725 / Z. The
    largest value, 655.35 m, is the sky and all that is farther, whose disparity is unknown.

    Args:
        root: holds `Scene01/clone/frames/rgb/Camera_0/rgb_00000.jpg` and `.../depth/Camera_0/depth_00000.png`,
            together or in the folders `vkitti_2.0.3_rgb` and `vkitti_2.0.3_depth` of the archives.
        split: "all".
        variation: "clone", "fog", "15-deg-left", ..., or "all" that are there.

    Raises:
        InputError: another tree, or an unknown split.

    Source: Cabon et al., Virtual KITTI 2, arXiv 2001.10773, 2020; the description of the data set.
    """
    root = Path(root)
    check_choice("split", split, ("all",))
    images, depths = (first_folder([root / f"vkitti_2.0.3_{part}"]) or root for part in ("rgb", "depth"))
    entries = [
        _entry(images, depths, place.relative_to(images), name)
        for scene in list_folder(images)
        for place in list_folder(scene)
        if variation in ("all", place.name)
        for name in image_names(place / "frames/rgb/Camera_0", place / "frames/rgb/Camera_1")
    ]
    expected = [f"Scene01/{'clone' if variation == 'all' else variation}/frames/rgb/Camera_0/rgb_00000.jpg"]
    return make_dataset("virtual_kitti2", root, split, entries, expected=expected)


def _entry(images: Path, depths: Path, place: Path, name: str) -> StereoEntry:
    left, right = (images / place / "frames/rgb" / camera / name for camera in ("Camera_0", "Camera_1"))
    stem = Path(name).stem
    depth = f"{stem.replace('rgb_', 'depth_')}.png"
    truth, right_truth = (depths / place / "frames/depth" / camera for camera in ("Camera_0", "Camera_1"))
    return StereoEntry(
        name=(place / stem).as_posix(),
        left=left,
        right=right,
        disparity=Source.within(truth, depth, _read),
        calibration=_CAMERA,
        right_disparity=Source.optional(right_truth / depth, _read),
    )


def _read(path: Path) -> Disparity:
    samples = read_samples(path)
    if samples.dtype != np.uint16 or samples.ndim != 2:
        raise InputError(f"{printable(path)}: expected depth in centimetres, a 16-bit grey PNG")
    depth = np.where(samples == _FARTHEST, np.nan, samples).astype(np.float64)
    return _CAMERA.disparity(depth / 100)
