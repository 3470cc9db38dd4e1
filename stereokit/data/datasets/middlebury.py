"""Middlebury: indoor scenes with structured-light ground truth, from 2001 to 2021.

Three kinds, because their files differ: the third evaluation (`middlebury_v3`), the scenes of 2014 and 2021
as they are published (`middlebury2014`), and the older scenes of 2001 to 2006 with scaled 8-bit disparity
(`middlebury_older`).
"""

from functools import partial
from pathlib import Path

from stereokit.calibration.formats.middlebury import read_middlebury_calibration
from stereokit.data.datasets.dataset import DATASETS, Mask, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import (
    check_choice,
    check_number,
    first_folder,
    folders_below,
    images_in,
    list_folder,
    make_dataset,
    scenes_of,
)
from stereokit.data.disparity_arrays import Disparity, PathLike
from stereokit.data.disparity_png import read_scaled_png
from stereokit.data.images import first_channel, read_image_size, read_samples
from stereokit.data.pfm import read_pfm
from stereokit.errors import InputError, printable
from stereokit.files import read_file_bytes

__all__ = ["middlebury2014", "middlebury2021", "middlebury_older", "middlebury_v3", "read_nonocc_mask"]

_RESOLUTIONS = ("F", "H", "Q")

# Left and right image, ground truth of each: the file names of the older scenes, most telling first.
_OLDER_NAMES = (
    ("imL", "imR", "groundtruth", None),  # the second evaluation
    ("view1", "view5", "disp1", "disp5"),  # 2005 and 2006
    ("scene1.row3.col3", "scene1.row3.col4", "truedisp.row3.col3", None),  # tsukuba, 2001
    ("im2", "im6", "disp2", "disp6"),  # 2001 and 2003
    ("im0", "im1", "disp0", "disp1"),  # map, 2001
)
_OLDER_SUFFIXES = (".png", ".ppm", ".pgm")
_SCALES_2001 = {
    "barn1": 8.0,
    "barn2": 8.0,
    "bull": 8.0,
    "map": 8.0,
    "poster": 8.0,
    "sawtooth": 8.0,
    "tsukuba": 16.0,
    "venus": 8.0,
}


@DATASETS.register("middlebury_v3")
def middlebury_v3(root: PathLike, *, split: str = "training", resolution: str = "H") -> StereoDataset:
    """The third Middlebury evaluation: 15 training and 15 test scenes in three sizes.

    Args:
        root: holds `trainingH/Adirondack/im0.png` and so on, and the ground truth beside it, `disp0GT.pfm`.
        split: "training" or "test".
        resolution: "F" (full), "H" (half) or "Q" (quarter).

    Raises:
        InputError: another tree, or an unknown split or resolution.

    Source: Scharstein et al., High-resolution stereo datasets with subpixel-accurate ground truth, GCPR 2014;
    https://vision.middlebury.edu/stereo/submit3/.
    """
    root = Path(root)
    check_choice("split", split, ("training", "test"))
    check_choice("resolution", resolution, _RESOLUTIONS)
    part = f"{split}{resolution}"
    entries = [
        _entry(scene, scene.name, "disp0GT.pfm", required=split == "training")
        for folder in (root / part, root / "MiddEval3" / part)
        for scene in scenes_of(list_folder(folder))
    ]
    return make_dataset("middlebury_v3", root, split, entries, expected=[f"{part}/Adirondack/im0.png"])


@DATASETS.register("middlebury2014")
def middlebury2014(root: PathLike, *, split: str = "all") -> StereoDataset:
    """Middlebury's scenes of 2014 and 2021 as published: full size, `disp0.pfm`, no masks.

    Args:
        root: holds the scenes' folders, such as `Adirondack-perfect/im0.png`.
        split: "all".

    Raises:
        InputError: another tree, or an unknown split.

    Source: https://vision.middlebury.edu/stereo/data/scenes2014/ and scenes2021/.
    """
    root = Path(root)
    check_choice("split", split, ("all",))
    entries = [
        _entry(scene, scene.name, "disp0.pfm", required=False) for scene in scenes_of([root, *list_folder(root)])
    ]
    return make_dataset("middlebury2014", root, split, entries, expected=["Adirondack-perfect/im0.png"])


@DATASETS.register("middlebury2021")
def middlebury2021(root: PathLike, *, split: str = "all") -> StereoDataset:
    """Middlebury's scenes of 2021, taken with a mobile phone: 24 pairs, full size, `disp0.pfm` and `disp1.pfm`.

    The pictures are `im0.png` and `im1.png`; those of other exposures and lights, which lie beside them, are not read.

    Args:
        root: holds the scenes' folders, such as `artroom1/im0.png`, or a folder `data` that does.
        split: "all".

    Raises:
        InputError: another tree, or an unknown split.

    Source: https://vision.middlebury.edu/stereo/data/scenes2021/.
    """
    root = Path(root)
    check_choice("split", split, ("all",))
    entries = [
        _entry(scene, scene.name, "disp0.pfm", required=False)
        for scene in scenes_of(list_folder(first_folder([root / "data"]) or root))
    ]
    return make_dataset("middlebury2021", root, split, entries, expected=["artroom1/im0.png"])


@DATASETS.register("middlebury_older")
def middlebury_older(root: PathLike, *, split: str = "all", scale: float | None = None) -> StereoDataset:
    """Middlebury's scenes of 2001, 2003, 2005 and 2006, and those of the second evaluation, in 8-bit
    disparity.

    The files do not say by how much disparity was scaled. Where `info.txt` names it that holds; else the
    published factors do: 8 for 2001 (tsukuba 16); 4 for 2003 at the usual quarter size, 2 and 1 at half and
    full size; 3, 2 and 1 for 2005 and 2006 at third, half and full size, told apart by the width of the
    image.

    Args:
        root: a scene's folder, or one that holds such folders, at any depth up to three.
        split: "all".
        scale: the stored value of one pixel of disparity, to overrule the above.

    Raises:
        InputError: another tree, an unknown split, or a scene whose scale is not known.

    Source: https://vision.middlebury.edu/stereo/data/, scenes2001 to scenes2006.
    """
    root = Path(root)
    check_choice("split", split, ("all",))
    factor = None if scale is None else check_number("scale", scale)
    found = {folder: _older_entry(root, folder, factor) for folder in folders_below(root, 3)}
    entries = [entry for entry in found.values() if entry]
    passed_over = [
        folder.relative_to(root).as_posix() for folder, entry in found.items() if not entry and images_in(folder)
    ]
    expected = ["a folder with view1.png, view5.png, disp1.png", "im2, im6, disp2", "imL, imR, groundtruth"]
    return make_dataset("middlebury_older", root, split, entries, expected=expected, passed_over=passed_over)


def read_nonocc_mask(path: Path) -> Mask:
    """Reads a mask of Middlebury or ETH3D, which is 255 at pixels that both cameras see.

    Other values are 128 for occluded and 0 for unknown.
    """
    mask: Mask = first_channel(read_samples(path)) == 255
    return mask


def _entry(scene: Path, name: str, truth: str, *, required: bool) -> StereoEntry:
    disparity = scene / truth
    return StereoEntry(
        name=name,
        left=scene / "im0.png",
        right=scene / "im1.png",
        disparity=Source(disparity, read_pfm) if required or disparity.is_file() else None,
        nonocc=Source.optional(scene / "mask0nocc.png", read_nonocc_mask),
        calibration=Source.optional(scene / "calib.txt", read_middlebury_calibration),
        right_disparity=Source.optional(scene / truth.replace("disp0", "disp1"), read_pfm),
        right_nonocc=Source.optional(scene / "mask1nocc.png", read_nonocc_mask),
    )


def _older_entry(root: Path, folder: Path, scale: float | None) -> StereoEntry | None:
    for names in _OLDER_NAMES:
        left, right, truth, right_truth = (_with_suffix(folder, name) if name else None for name in names)
        if sum(path is not None for path in (left, right, truth)) < 2:
            continue
        suffix = next(path.suffix for path in (left, right) if path)
        left, right = left or folder / f"{names[0]}{suffix}", right or folder / f"{names[1]}{suffix}"
        read = partial(_read_older, truth=truth, left=left, scale=scale) if truth else None
        return StereoEntry(
            name=folder.relative_to(root).as_posix() if folder != root else folder.resolve().name,
            left=left,
            right=right,
            disparity=Source(truth, read) if truth and read else None,
            nonocc=Source.optional(folder / "nonocc.png", read_nonocc_mask),
            right_disparity=Source(right_truth, read) if right_truth and read else None,
        )
    return None


def _with_suffix(folder: Path, name: str) -> Path | None:
    return next((path for suffix in _OLDER_SUFFIXES if (path := folder / f"{name}{suffix}").is_file()), None)


def _read_older(path: Path, *, truth: Path, left: Path, scale: float | None) -> Disparity:
    """Reads either view's disparity, which is scaled as the left view's one, `truth`, is."""
    return read_scaled_png(path, scale=scale or _published_scale(truth, left))


def _published_scale(truth: Path, left: Path) -> float:
    info = truth.parent / "info.txt"
    if info.is_file():
        words = read_file_bytes(info, 1024).split()
        if words and words[0].isdigit() and int(words[0]) > 0:
            return float(words[0])
        raise InputError(f"{printable(info)}: expected the scale of the disparity in its first line")
    scene = truth.parent.name.lower()
    width, _ = read_image_size(left)
    if truth.stem == "disp1":
        return 3.0 if width < 500 else 2.0 if width < 800 else 1.0
    if scene.startswith(("teddy", "cones")):
        return 4.0 if width < 600 else 2.0 if width < 1200 else 1.0
    if scene in _SCALES_2001:
        return _SCALES_2001[scene]
    raise InputError(
        f"{printable(truth)} does not say by how much its disparity was scaled, and the scene {scene!r} is "
        "not one of the published ones; give scale=, the stored value of one pixel of disparity"
    )
