"""DrivingStereo: 182188 pairs of Chinese streets, ground truth from laser scans, in half and full size."""

import re
from pathlib import Path

from stereokit.calibration.formats.kitti import read_drivingstereo_calibration
from stereokit.calibration.rectified import Calibration
from stereokit.data.datasets.dataset import DATASETS, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import check_choice, first_folder, image_names, list_folder, make_dataset
from stereokit.data.disparity_arrays import PathLike
from stereokit.data.disparity_png import read_drivingstereo_full_png, read_kitti_png

__all__ = ["drivingstereo"]

_WEATHER = ("sunny", "cloudy", "foggy", "rainy")
_PARTS = ("left-image", "right-image", "disparity-map")
_SEQUENCE = re.compile(r"\d{4}(-\d{2}){5}")


@DATASETS.register("drivingstereo")
def drivingstereo(root: PathLike, *, split: str = "test", size: str = "half") -> StereoDataset:
    """DrivingStereo: 174437 training and 7751 test pairs, and 500 pairs for each kind of weather.

    Args:
        root: holds `test-left-image`, `test-right-image`, `test-disparity-map`, the same of `train`, and the
            weathers' folders `sunny`, `cloudy`, `foggy`, `rainy`, as they are there.
        split: "train", "test", or a weather.
        size: "half" (about 880 x 400, disparity stored * 256) or "full" (about 1760 x 800, stored * 128).

    Raises:
        InputError: another tree, or an unknown split or size.

    Source: Yang et al., DrivingStereo: a large-scale dataset for stereo matching in autonomous driving
    scenarios, CVPR 2019; https://drivingstereo-dataset.github.io/.
    """
    root = Path(root)
    check_choice("split", split, ("train", "test", *_WEATHER))
    check_choice("size", size, ("half", "full"))
    if split in _WEATHER:
        left, right, truth = (root / split / f"{part}-{size}-size" for part in _PARTS)
    else:
        left, right, truth = (_sized(root / f"{split}-{part}", f"{part}-{size}-size", size) for part in _PARTS)
    calibrations = first_folder([root / "calib" / f"{size}-image-calib", root / f"{size}-image-calib"])
    read = read_kitti_png if size == "half" else read_drivingstereo_full_png
    entries = [
        StereoEntry(
            name=Path(sequence, name).with_suffix("").as_posix(),
            left=left / sequence / name,
            right=right / sequence / name,
            disparity=Source.within(truth, Path(sequence, name).with_suffix(".png").as_posix(), read),
            calibration=_calibration(calibrations, name),
        )
        for sequence in ("", *sorted({path.name for view in (left, right) for path in list_folder(view)}))
        for name in image_names(left / sequence, right / sequence)
    ]
    expected = [f"{left.relative_to(root).as_posix()}/"]
    return make_dataset("drivingstereo", root, split, entries, expected=expected)


def _sized(folder: Path, sized: str, size: str) -> Path:
    """The folder of one size. The archives of half-size images come without one."""
    return folder if size == "half" and not (folder / sized).is_dir() else folder / sized


def _calibration(folder: Path | None, name: str) -> Source[Calibration] | None:
    sequence = _SEQUENCE.match(name)
    if folder is None or sequence is None or not (folder / f"{sequence[0]}.txt").is_file():
        return None
    return Source(folder / f"{sequence[0]}.txt", read_drivingstereo_calibration)
