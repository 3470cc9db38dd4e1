"""KITTI: the stereo benchmarks of 2012 and 2015, and the raw recordings.

Images may be PNG, or JPEG as many keep them; ground truth is PNG. Frames _11, which are for the flow benchmarks, have
no ground truth and are left out.

The benchmarks have ground truth for their training part alone. To choose hyper-parameters the field splits
that part into 90 % for training and 10 % for validation, and the publications do not list the frames. Ours
are fixed by the number of the frame: it is validation if the number can be divided by ten (000000, 000010,
...), which gives 20 of the 194 frames of 2012 and 20 of the 200 frames of 2015.
"""

import re
from collections.abc import Mapping, Sequence, Set
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from stereokit.calibration.formats.kitti import read_kitti_calibration
from stereokit.data.datasets.dataset import DATASETS, Mask, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import (
    check_choice,
    first_folder,
    image_names,
    images_by_stem,
    list_folder,
    make_dataset,
)
from stereokit.data.disparity_arrays import PathLike
from stereokit.data.disparity_png import is_grey, read_kitti_png
from stereokit.data.images import first_channel, read_samples
from stereokit.errors import InputError, printable

__all__ = ["is_validation_frame", "kitti2012", "kitti2015", "kitti_raw"]

_SPLITS = ("training", "train", "val", "testing")
_FRAME = re.compile(r"\d+_10")
_VIEWS = ("auto", "colour", "grey")


def is_validation_frame(number: int) -> bool:
    """Whether a frame of KITTI's training part belongs to the 10 % held out for validation.

    >>> sum(is_validation_frame(number) for number in range(200))
    20
    """
    return number % 10 == 0


@DATASETS.register("kitti2012")
def kitti2012(root: PathLike, *, split: str = "training", views: str = "auto") -> StereoDataset:
    """KITTI stereo 2012: 194 training and 195 test pairs of street scenes, sparse ground truth from a laser
    scanner.

    Args:
        root: holds `training` and `testing`.
        split: "training" (all frames with ground truth), "train" and "val" (90 % and 10 % of them), or
            "testing".
        views: "colour" (colored_0, colored_1), "grey" (image_0, image_1), or "auto", colour where it is
            there.

    Raises:
        InputError: another tree, or an unknown split.

    Source: Geiger et al., Are we ready for autonomous driving?, CVPR 2012; readme of the development kit.
    """
    root = Path(root)
    folder = _part(root, split, "data_stereo_flow")
    check_choice("views", views, _VIEWS)
    pairs = {"colour": ("colored_0", "colored_1"), "grey": ("image_0", "image_1")}
    if views == "auto":
        views = "colour" if (folder / "colored_0").is_dir() else "grey"
    left, right = pairs[views]
    cameras = ("2", "3") if views == "colour" else ("0", "1")
    lefts, rights = images_by_stem(folder / left), images_by_stem(folder / right)
    frames = _reference_frames({*lefts, *rights}, split)
    entries = [
        StereoEntry(
            name=frame,
            left=lefts.get(frame, folder / left / f"{frame}.png"),
            right=rights.get(frame, folder / right / f"{frame}.png"),
            disparity=Source.within(folder / "disp_occ", f"{frame}.png", read_kitti_png),
            nonocc=Source.within(folder / "disp_noc", f"{frame}.png", _read_nonocc),
            calibration=Source.within(
                folder / "calib", f"{frame[:-3]}.txt", partial(read_kitti_calibration, cameras=cameras)
            ),
        )
        for frame in frames[split]
    ]
    expected = [f"{folder.name}/{left}/*_10.png"]
    return make_dataset("kitti2012", root, split, entries, expected=expected, filled=_filled(frames))


@DATASETS.register("kitti2015")
def kitti2015(root: PathLike, *, split: str = "training") -> StereoDataset:
    """KITTI stereo 2015: 200 training and 200 test pairs of street scenes, with cars fitted into the ground
    truth.

    Args:
        root: holds `training` and `testing`.
        split: "training" (all frames with ground truth), "train" and "val" (90 % and 10 % of them), or
            "testing".

    Raises:
        InputError: another tree, or an unknown split.

    Source: Menze and Geiger, Object scene flow for autonomous vehicles, CVPR 2015; the development kit's
    readme.
    """
    root = Path(root)
    folder = _part(root, split, "data_scene_flow")
    lefts, rights = images_by_stem(folder / "image_2"), images_by_stem(folder / "image_3")
    frames = _reference_frames({*lefts, *rights}, split)
    entries = [
        StereoEntry(
            name=frame,
            left=lefts.get(frame, folder / "image_2" / f"{frame}.png"),
            right=rights.get(frame, folder / "image_3" / f"{frame}.png"),
            disparity=Source.within(folder / "disp_occ_0", f"{frame}.png", read_kitti_png),
            nonocc=Source.within(folder / "disp_noc_0", f"{frame}.png", _read_nonocc),
            objects=Source.within(folder / "obj_map", f"{frame}.png", _read_objects),
            calibration=Source.within(
                folder / "calib_cam_to_cam",
                f"{frame[:-3]}.txt",
                partial(read_kitti_calibration, cameras=("02", "03")),
            ),
        )
        for frame in frames[split]
    ]
    expected = [f"{folder.name}/image_2/*_10.png"]
    return make_dataset("kitti2015", root, split, entries, expected=expected, filled=_filled(frames))


@DATASETS.register("kitti_raw")
def kitti_raw(root: PathLike, *, split: str = "all", views: str = "colour") -> StereoDataset:
    """KITTI raw data, synchronised and rectified: drives through Karlsruhe, without ground truth.

    Args:
        root: holds dates (`2011_09_26/2011_09_26_drive_0001_sync/image_02/data`).
        split: "all".
        views: "colour" (image_02, image_03) or "grey" (image_00, image_01).

    Raises:
        InputError: another tree, or an unknown split.

    Source: Geiger et al., Vision meets robotics: the KITTI dataset, IJRR 2013.
    """
    root = Path(root)
    check_choice("split", split, ("all",))
    check_choice("views", views, _VIEWS[1:])
    left, right = ("02", "03") if views == "colour" else ("00", "01")
    read = partial(read_kitti_calibration, cameras=(left, right))
    entries = [
        StereoEntry(
            name=f"{drive.name}/{Path(name).stem}",
            left=drive / f"image_{left}" / "data" / name,
            right=drive / f"image_{right}" / "data" / name,
            calibration=Source(calibration, read) if calibration.is_file() else None,
        )
        for date in list_folder(root)
        for calibration in [date / "calib_cam_to_cam.txt"]
        for drive in list_folder(date)
        for name in image_names(drive / f"image_{left}" / "data", drive / f"image_{right}" / "data")
    ]
    expected = [f"2011_09_26/2011_09_26_drive_0001_sync/image_{left}/data/*.png"]
    return make_dataset("kitti_raw", root, split, entries, expected=expected)


def _part(root: Path, split: str, archive: str) -> Path:
    check_choice("split", split, _SPLITS)
    part = "testing" if split == "testing" else "training"
    return first_folder([root / part, root / archive / part]) or root / part


def _reference_frames(stems: Set[str], split: str) -> dict[str, list[str]]:
    """The frames that can have ground truth, *_10, by split; the others belong to the flow benchmarks."""
    frames = sorted(stem for stem in stems if _FRAME.fullmatch(stem))
    if split == "testing":
        return {"testing": frames}
    parts: dict[str, list[str]] = {"training": frames, "train": [], "val": []}
    for frame in frames:
        parts["val" if is_validation_frame(int(frame[:-3])) else "train"].append(frame)
    return parts


def _filled(frames: Mapping[str, Sequence[str]]) -> list[str]:
    return [split for split, names in frames.items() if names]


def _read_nonocc(path: Path) -> Mask:
    """The pixels with ground truth in `disp_noc`, which holds those that both cameras see."""
    return np.isfinite(read_kitti_png(path))


def _read_objects(path: Path) -> npt.NDArray[np.uint8]:
    samples = read_samples(path)
    if samples.dtype != np.uint8 or not is_grey(samples):
        raise InputError(f"{printable(path)}: expected an object map, an 8-bit grey PNG")
    return first_channel(samples)
