"""MPI Sintel stereo: an animated film, rendered, with dense ground truth and masks of what is hidden."""

from functools import partial
from pathlib import Path

from stereokit.data.datasets.dataset import DATASETS, Mask, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import check_choice, first_folder, image_names, list_folder, make_dataset
from stereokit.data.disparity_arrays import PathLike
from stereokit.data.disparity_png import read_sintel_png
from stereokit.data.images import first_channel, read_samples
from stereokit.errors import InputError, printable

__all__ = ["sintel"]


@DATASETS.register("sintel")
def sintel(root: PathLike, *, split: str = "training", image_pass: str = "final") -> StereoDataset:
    """MPI Sintel stereo: 1064 pairs of 1024 x 436.

    A pixel counts as non-occluded if it is neither in the mask of occlusions nor in that of pixels out of the
    frame.

    Args:
        root: holds `training`.
        split: "training", the only one there is.
        image_pass: "final" (with motion blur and atmosphere) or "clean".

    Raises:
        InputError: another tree, or an unknown split or pass.

    Source: Butler et al., A naturalistic open source movie for optical flow evaluation, ECCV 2012; readme of
    the stereo data.
    """
    root = Path(root)
    check_choice("split", split, ("training",))
    check_choice("image_pass", image_pass, ("final", "clean"))
    folder = first_folder([root / "training"]) or root
    lefts, rights = folder / f"{image_pass}_left", folder / f"{image_pass}_right"
    entries = [
        StereoEntry(
            name=f"{scene}/{Path(name).stem}",
            left=lefts / scene / name,
            right=rights / scene / name,
            disparity=Source.within(folder / "disparities", f"{scene}/{name}", read_sintel_png),
            nonocc=Source.within(
                folder / "occlusions",
                f"{scene}/{name}",
                partial(_read_nonocc, outside=folder / "outofframe" / scene / name),
            ),
        )
        for scene in sorted({path.name for path in (*list_folder(lefts), *list_folder(rights))})
        for name in image_names(lefts / scene, rights / scene)
    ]
    expected = [f"training/{image_pass}_left/alley_1/*.png"]
    return make_dataset("sintel", root, split, entries, expected=expected)


def _read_nonocc(path: Path, *, outside: Path) -> Mask:
    occluded, out_of_frame = (_read_set(mask) for mask in (path, outside))
    if occluded.shape != out_of_frame.shape:
        raise InputError(f"{printable(path)} and {printable(outside)} are of different sizes; expected one")
    return ~(occluded | out_of_frame)


def _read_set(path: Path) -> Mask:
    return first_channel(read_samples(path)) > 0
