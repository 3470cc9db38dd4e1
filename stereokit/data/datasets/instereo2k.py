"""InStereo2K: indoor scenes, ground truth by structured light."""

from functools import partial
from pathlib import Path

from stereokit.data.datasets.dataset import DATASETS, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import check_choice, folders_below, make_dataset
from stereokit.data.disparity_arrays import PathLike
from stereokit.data.disparity_png import read_scaled_png

__all__ = ["instereo2k"]

_SCALE = 100


@DATASETS.register("instereo2k")
def instereo2k(root: PathLike, *, split: str = "test") -> StereoDataset:
    """InStereo2K: 2000 training and 50 test pairs of 1080 x 860.

    Disparity is stored times 100 in 16 bits, 0 where unknown, for both views.

    Args:
        root: holds `train` and `test`, with a folder for each scene that holds `left.png`, `right.png`,
            `left_disp.png` and `right_disp.png`; the training archives' folders (`part1`, ...) may stand between.
        split: "train", "test", or "all" for whatever lies there.

    Raises:
        InputError: another tree, or an unknown split.

    Source: Bao et al., InStereo2K: a large real dataset for stereo matching in indoor scenes, SCIS 2020; its readme.
    """
    root = Path(root)
    check_choice("split", split, ("train", "test", "all"))
    read = partial(read_scaled_png, scale=_SCALE)
    entries = [
        StereoEntry(
            name=scene.relative_to(root).as_posix() if scene != root else scene.resolve().name,
            left=scene / "left.png",
            right=scene / "right.png",
            disparity=Source(scene / "left_disp.png", read),
            right_disparity=Source.optional(scene / "right_disp.png", read),
        )
        for scene in folders_below(root if split == "all" else root / split, 3)
        if (scene / "left_disp.png").is_file()
    ]
    expected = [f"{'' if split == 'all' else split + '/'}000000/left.png, right.png, left_disp.png"]
    return make_dataset("instereo2k", root, split, entries, expected=expected)
