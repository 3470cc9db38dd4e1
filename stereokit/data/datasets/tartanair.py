"""TartanAir: flights through rendered places, with dense depth for both views."""

from pathlib import Path

from stereokit.calibration import Calibration
from stereokit.data.datasets.dataset import DATASETS, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import check_choice, folders_below, image_names, make_dataset
from stereokit.data.disparity_arrays import Disparity, PathLike
from stereokit.data.npy import read_npy

__all__ = ["tartanair"]

_CAMERA = Calibration(fx=320.0, baseline=0.25, cx0=320.0, cx1=320.0, width=640, height=480)


@DATASETS.register("tartanair")
def tartanair(root: PathLike, *, split: str = "all", difficulty: str = "all") -> StereoDataset:
    """TartanAir: some 300000 pairs of 640 x 480, of which each trajectory is a folder.

    Disparity is computed from the depth in metres, d = 320 * 0.25 / Z. The second version of the data set, whose
    depth is encoded in PNG, has another layout and is not read.

    Args:
        root: holds `ENVIRONMENT/Easy/P000/image_left/000000_left.png`, `image_right` and `depth_left` with
            `000000_left_depth.npy`; up to five folders deep.
        split: "all".
        difficulty: "Easy", "Hard" or "all".

    Raises:
        InputError: another tree, or an unknown split or difficulty.

    Source: Wang et al., TartanAir: a dataset to push the limits of visual SLAM, IROS 2020; the tools of its authors.
    """
    root = Path(root)
    check_choice("split", split, ("all",))
    check_choice("difficulty", difficulty, ("Easy", "Hard", "all"))
    entries = [
        _entry(root, trajectory, frame)
        for trajectory in folders_below(root, 4)
        if (trajectory / "image_left").is_dir() and difficulty in ("all", *trajectory.parts)
        for frame in sorted(
            {name.split("_")[0] for name in image_names(trajectory / "image_left", trajectory / "image_right")}
        )
    ]
    expected = ["abandonedfactory/Easy/P000/image_left/000000_left.png"]
    return make_dataset("tartanair", root, split, entries, expected=expected)


def _entry(root: Path, trajectory: Path, frame: str) -> StereoEntry:
    right_depth = trajectory / "depth_right" / f"{frame}_right_depth.npy"
    return StereoEntry(
        name=(trajectory / frame).relative_to(root).as_posix(),
        left=trajectory / "image_left" / f"{frame}_left.png",
        right=trajectory / "image_right" / f"{frame}_right.png",
        disparity=Source.within(trajectory / "depth_left", f"{frame}_left_depth.npy", _read),
        calibration=_CAMERA,
        right_disparity=Source.optional(right_depth, _read),
    )


def _read(path: Path) -> Disparity:
    return _CAMERA.disparity(read_npy(path))
