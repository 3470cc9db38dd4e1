"""CREStereo's rendered pairs, with dense ground truth for both views."""

from functools import partial
from pathlib import Path

from stereokit.data.datasets.dataset import DATASETS, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import check_choice, folders_below, images_in, make_dataset
from stereokit.data.disparity_arrays import PathLike
from stereokit.data.disparity_png import read_scaled_png

__all__ = ["crestereo"]

_SCALE = 32
_PARTS = ("tree", "shapenet", "reflective", "hole")


@DATASETS.register("crestereo")
def crestereo(root: PathLike, *, split: str = "train", part: str = "all") -> StereoDataset:
    """CREStereo: rendered pairs of 1920 x 1080, of trees, objects, mirrors and holes.

    Disparity is stored times 32 in PNG, 0 where unknown.

    Args:
        root: holds `tree`, `shapenet`, `reflective` and `hole`, as they are there, with files `..._left.jpg`,
            `..._right.jpg`, `..._left.disp.png` and `..._right.disp.png`, up to three folders deep.
        split: "train", the only one there is.
        part: one of the four, or "all" that are there.

    Raises:
        InputError: another tree, or an unknown split or part.

    Source: Li et al., Practical stereo matching via cascaded recurrent network with adaptive correlation, CVPR 2022;
    the loader of its authors.
    """
    root = Path(root)
    check_choice("split", split, ("train",))
    check_choice("part", part, ("all", *_PARTS))
    read = partial(read_scaled_png, scale=_SCALE)
    stems = sorted(
        {
            folder / path.stem.rpartition("_")[0]
            for folder in folders_below(root if part == "all" else root / part, 3)
            for path in images_in(folder)
            if path.suffix == ".jpg" and path.stem.endswith(("_left", "_right"))
        }
    )
    entries = [
        StereoEntry(
            name=stem.relative_to(root).as_posix(),
            left=stem.with_name(f"{stem.name}_left.jpg"),
            right=stem.with_name(f"{stem.name}_right.jpg"),
            disparity=Source(stem.with_name(f"{stem.name}_left.disp.png"), read),
            right_disparity=Source.optional(stem.with_name(f"{stem.name}_right.disp.png"), read),
        )
        for stem in stems
    ]
    expected = [f"{'tree' if part == 'all' else part}/0/..._left.jpg, ..._right.jpg, ..._left.disp.png"]
    return make_dataset("crestereo", root, split, entries, expected=expected)
