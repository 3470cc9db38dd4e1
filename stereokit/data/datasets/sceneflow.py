"""SceneFlow: FlyingThings3D, Monkaa and Driving, rendered, with dense ground truth for both views.

The archives unpack into several trees, and projects rearrange them. All of these are found, below the given
folder or below folders in it named after the three parts:

- `frames_cleanpass` or `frames_finalpass`, and `disparity` (as distributed);
- the same with the prefixes `monkaa_` and `driving_`, and `frames_disparity` (as many projects keep them);
- FlyingThings3D's subset for DispNet: `train` and `val` with `image_clean` or `image_final`, and `disparity`;
- `left`, `right` and `disparity/left` alone (as in the sample packs), which have no passes and no splits.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np

from stereokit.data.datasets.dataset import DATASETS, Mask, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import (
    check_choice,
    first_folder,
    image_names,
    is_visible,
    list_folder,
    make_dataset,
)
from stereokit.data.disparity_arrays import Disparity, PathLike
from stereokit.data.images import read_samples
from stereokit.data.pfm import read_pfm
from stereokit.errors import InputError, printable

__all__ = ["read_sceneflow_disparity", "sceneflow"]

_PARTS = ("flyingthings3d", "monkaa", "driving")
_PREFIXES = ("", "flyingthings3d_", "flyingthings3d__", "monkaa_", "monkaa__", "driving_", "driving__")
T = TypeVar("T")
_Found: TypeAlias = tuple[str, str, StereoEntry]
_SUBSET_PASSES = {"cleanpass": "image_clean", "finalpass": "image_final"}


@DATASETS.register("sceneflow")
def sceneflow(
    root: PathLike, *, split: str = "test", image_pass: str = "finalpass", part: str = "all"
) -> StereoDataset:
    """SceneFlow: 35454 training pairs and 4370 test pairs of 960 x 540.

    Args:
        root: holds one or more of the trees that the module's documentation lists.
        split: "test" (FlyingThings3D's TEST), "train" (its TRAIN, Monkaa and Driving) or "all".
        image_pass: "finalpass" (with motion blur and haze) or "cleanpass".
        part: "flyingthings3d", "monkaa", "driving" or "all" that are there.

    Raises:
        InputError: another tree, or an unknown split, pass or part.

    Source: Mayer et al., A large dataset to train convolutional networks for disparity, optical flow, and
    scene flow estimation, CVPR 2016.
    """
    root = Path(root)
    check_choice("split", split, ("test", "train", "all"))
    check_choice("image_pass", image_pass, tuple(_SUBSET_PASSES))
    check_choice("part", part, ("all", *_PARTS))
    bases = [
        root,
        *(path for path in list_folder(root) if path.name.lower().startswith(_PARTS) and path.is_dir()),
    ]
    found = [
        (found_split, entry)
        for base in bases
        for found_part, found_split, entry in (
            *_frames(root, base, image_pass),
            *_subset(root, base, image_pass),
        )
        if part in ("all", found_part)
    ]
    entries = [entry for found_split, entry in found if split in ("all", found_split)]
    filled = sorted({found_split for found_split, _ in found})
    if not entries and part == "all":
        entries = list(_flat(root))
    expected = [
        f"frames_{image_pass}/TEST/A/0000/left/*.png with disparity/",
        "left/ with right/ and disparity/left/",
    ]
    return make_dataset("sceneflow", root, split, entries, expected=expected, filled=filled)


def read_sceneflow_disparity(path: PathLike) -> Disparity:
    """Reads a PFM of SceneFlow, whose sign differs between its archives, as positive disparity.

    The subset for DispNet stores x_right - x_left, below zero throughout.

    Raises:
        InputError: a missing or broken file, or one with both signs.
    """
    disparity = read_pfm(path)
    if not (disparity < 0).any():
        return disparity
    if (disparity > 0).any():
        raise InputError(f"{printable(path)} holds disparity of both signs; expected one sign throughout")
    return -disparity


def _frames(root: Path, base: Path, image_pass: str) -> Iterator[_Found]:
    for prefix in _PREFIXES:
        name = f"{prefix}frames_{image_pass}"
        frames = first_folder([base / name, base / f"{name}_webp"])
        truths = first_folder([base / f"{prefix}disparity", base / f"{prefix}frames_disparity"])
        if frames is None:
            continue
        for left in sorted((*frames.glob("*/left"), *frames.glob("*/*/*/left"))):
            if not is_visible(left, frames):
                continue
            place = left.relative_to(frames).parent
            part, split = _part_and_split(place.parts[0])
            for entry in _entries(root, left.parent, truths / place / "left" if truths else None):
                yield part, split, entry


def _part_and_split(top: str) -> tuple[str, str]:
    if top in ("TRAIN", "TEST"):
        return "flyingthings3d", top.lower()
    return ("driving" if "focallength" in top else "monkaa"), "train"


def _subset(root: Path, base: Path, image_pass: str) -> Iterator[_Found]:
    for folder, split in ((base / "train", "train"), (base / "val", "test")):
        truths = first_folder([folder / "disparity" / "left"])
        occluded = folder / "disparity_occlusions" / "left"
        for entry in _entries(root, folder / _SUBSET_PASSES[image_pass], truths, occluded):
            yield "flyingthings3d", split, entry


def _flat(root: Path) -> Iterator[StereoEntry]:
    return _entries(root, root, first_folder([root / "disparity" / "left"]))


def _entries(root: Path, views: Path, truths: Path | None, occluded: Path | None = None) -> Iterator[StereoEntry]:
    for name in image_names(views / "left", views / "right"):
        left, stem = views / "left" / name, Path(name).stem
        yield StereoEntry(
            name=left.relative_to(root).with_suffix("").as_posix(),
            left=left,
            right=views / "right" / name,
            disparity=Source(truths / f"{stem}.pfm", read_sceneflow_disparity) if truths else None,
            nonocc=Source.within(occluded, f"{stem}.png", _read_nonocc) if occluded else None,
            right_disparity=_of_right_view(truths, f"{stem}.pfm", read_sceneflow_disparity),
            right_nonocc=_of_right_view(occluded, f"{stem}.png", _read_nonocc),
        )


def _of_right_view(lefts: Path | None, name: str, read: Callable[[Path], T]) -> Source[T] | None:
    """The right view's file beside a folder of the left views' ones, which many keep alone."""
    return Source.optional(lefts.with_name("right") / name, read) if lefts else None


def _read_nonocc(path: Path) -> Mask:
    """The subset's occlusion maps are set where the left pixel is not seen from the right."""
    samples = read_samples(path)
    return samples == 0 if samples.ndim == 2 else np.logical_not(samples[:, :, :3].any(axis=2))
