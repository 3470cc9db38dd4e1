"""ETH3D's low-resolution two-view benchmark: grey images, ground truth from a laser scanner."""

from pathlib import Path

from stereokit.calibration.formats.middlebury import read_middlebury_calibration
from stereokit.data.datasets.dataset import DATASETS, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import check_choice, first_folder, list_folder, make_dataset, scenes_of
from stereokit.data.datasets.middlebury import read_nonocc_mask
from stereokit.data.disparity_arrays import PathLike
from stereokit.data.pfm import read_pfm

__all__ = ["eth3d"]

_TRUTHS = ("disp0GT.pfm", "disp0.pfm")


@DATASETS.register("eth3d")
def eth3d(root: PathLike, *, split: str = "training") -> StereoDataset:
    """ETH3D two-view: 27 training and 20 test pairs.

    Args:
        root: holds `two_view_training` with `two_view_training_gt`, and `two_view_test`; or the scenes
            themselves. The ground truth (`disp0GT.pfm`, or `disp0.pfm`) may lie beside the images too.
        split: "training" or "test".

    Raises:
        InputError: another tree, or an unknown split.

    Source: Schöps et al., A multi-view stereo benchmark with high-resolution images and multi-camera videos,
    CVPR 2017; https://www.eth3d.net/documentation.
    """
    root = Path(root)
    check_choice("split", split, ("training", "test"))
    folder = first_folder([root / f"two_view_{split}", root / split])
    if folder is None and split == "training":
        folder = root
    truths = first_folder([root / f"two_view_{split}_gt"])
    entries = [
        _entry(scene, truths / scene.name if truths else None)
        for scene in scenes_of(list_folder(folder) if folder else [])
    ]
    return make_dataset("eth3d", root, split, entries, expected=[f"two_view_{split}/delivery_area_1l/im0.png"])


def _entry(scene: Path, separate: Path | None) -> StereoEntry:
    beside = next((path for name in _TRUTHS if (path := scene / name).is_file()), None)
    disparity = separate / _TRUTHS[0] if separate else beside
    nonocc = disparity.parent / "mask0nocc.png" if disparity else scene / "mask0nocc.png"
    calibration = scene / "calib.txt"
    return StereoEntry(
        name=scene.name,
        left=scene / "im0.png",
        right=scene / "im1.png",
        disparity=Source(disparity, read_pfm) if disparity else None,
        nonocc=Source(nonocc, read_nonocc_mask) if nonocc.is_file() else None,
        calibration=Source(calibration, read_middlebury_calibration) if calibration.is_file() else None,
    )
