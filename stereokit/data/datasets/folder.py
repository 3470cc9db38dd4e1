"""One's own pairs: a folder of them, or a list file."""

import shlex
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from stereokit.data.calibration import Calibration, read_calibration
from stereokit.data.datasets.dataset import DATASETS, Source, StereoDataset, StereoEntry
from stereokit.data.datasets.layout import (
    check_choice,
    check_number,
    first_folder,
    list_folder,
    make_dataset,
)
from stereokit.data.datasets.middlebury import read_nonocc_mask
from stereokit.data.disparity_arrays import Disparity, PathLike
from stereokit.data.disparity_files import read_disparity
from stereokit.data.images import IMAGE_SUFFIXES, read_file_bytes
from stereokit.errors import InputError, printable
from stereokit.registry import suggest

__all__ = ["folder"]

_SUFFIXES = (".pfm", ".npy", ".npz", *sorted(IMAGE_SUFFIXES))
_CALIBRATION_NAMES = ("calib.txt", "calib.yml", "calib.yaml")
_LINE_KEYS = ("nonocc", "calibration", "scale", "encoding", "name")


@DATASETS.register("folder")
def folder(
    root: PathLike, *, split: str = "all", scale: float | None = None, encoding: str | None = None
) -> StereoDataset:
    """One's own pairs.

    `root` is one of three:

    - a folder with `left` and `right`, whose images have the same names, and if there is ground truth
      `disparity` with files of the same stem;
    - a folder with `left.png` and `right.png` (of any image format) and perhaps `disparity.pfm` (of any
      disparity format), or one that holds such folders;
    - a list file with a pair in each line: left image, right image and perhaps disparity, relative to the
      list, in quotes where a name has blanks. After them `key=value` may follow, with `scale` or `encoding`
      (of `read_disparity`), `nonocc` (a mask, 255 where both cameras see), `calibration` (a file) and `name`.
      A `#` begins a comment.

    A file `calib.txt`, `calib.yml` or `calib.yaml` beside the images, or in the folder above them, is read as
    their calibration. Beside ground truth in a folder of its own a mask may lie in `nonocc`, with the same
    name.

    Args:
        root: the folder or the list file.
        split: "all".
        scale: the stored value of one pixel of disparity, for 8-bit ground truth.
        encoding: of the ground truth, where its files do not tell (see `read_disparity`).

    Raises:
        InputError: no pairs, an unknown split, or a line that can't be understood.
    """
    root = Path(root)
    check_choice("split", split, ("all",))
    read = partial(read_disparity, scale=None if scale is None else check_number("scale", scale), encoding=encoding)
    if root.is_file():
        entries = list(_from_list(root, read))
    elif (root / "left").is_dir():
        entries = list(_from_parallel_folders(root, read))
    else:
        entries = [entry for scene in [root, *list_folder(root)] if (entry := _from_scene(scene, read))]
    expected = ["left/*.png and right/*.png", "*/left.png and */right.png", "a list file"]
    return make_dataset("folder", root, split, entries, expected=expected)


def _from_parallel_folders(root: Path, read: Callable[[Path], Disparity]) -> Iterator[StereoEntry]:
    truth_folder = first_folder([root / "disparity" / "left", root / "disparity"])
    truths = _by_stem(truth_folder) if truth_folder else {}
    lefts, rights, masks = (_by_stem(root / part) for part in ("left", "right", "nonocc"))
    for stem in sorted(lefts.keys() | rights.keys()):
        # A file that should be there and is not keeps its likely name, so that the error can say it.
        truth = truths.get(stem, truth_folder / f"{stem}.pfm") if truth_folder else None
        yield StereoEntry(
            name=stem,
            left=lefts.get(stem, root / "left" / f"{stem}.png"),
            right=rights.get(stem, root / "right" / f"{stem}.png"),
            disparity=Source(truth, read) if truth else None,
            nonocc=Source(masks[stem], read_nonocc_mask) if stem in masks else None,
            calibration=_calibration(root),
        )


def _from_scene(scene: Path, read: Callable[[Path], Disparity]) -> StereoEntry | None:
    files = _by_stem(scene)
    if not {"left", "right"} & files.keys():
        return None
    return StereoEntry(
        name=scene.resolve().name,
        left=files.get("left", scene / "left.png"),
        right=files.get("right", scene / "right.png"),
        disparity=Source(files["disparity"], read) if "disparity" in files else None,
        nonocc=Source(files["nonocc"], read_nonocc_mask) if "nonocc" in files else None,
        calibration=_calibration(scene, scene.parent),
    )


def _from_list(path: Path, read: Callable[[Path], Disparity]) -> Iterator[StereoEntry]:
    data = read_file_bytes(path)
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{printable(path)} is no list of pairs: it is not UTF-8 text ({error.reason})") from error
    for number, line in enumerate(lines, start=1):
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise InputError(f"{printable(path)}, line {number}: {error}") from error
        if words:
            yield _from_line(path, number, words, read)


def _from_line(path: Path, number: int, words: list[str], read: Callable[[Path], Disparity]) -> StereoEntry:
    where = f"{printable(path)}, line {number}"
    files = [word for word in words if "=" not in word]
    values = dict(word.split("=", 1) for word in words if "=" in word)
    if len(files) not in (2, 3):
        raise InputError(f"{where}: expected a left image, a right image and perhaps disparity, got {len(files)} files")
    for key in values:
        if key not in _LINE_KEYS:
            raise InputError(f"{where}: unknown {key!r}; {suggest(key, list(_LINE_KEYS))}")
    left, right, *truth = (path.parent / name for name in files)
    if values.keys() & {"scale", "encoding"}:
        scale = check_number(f"{where}: scale", values["scale"]) if "scale" in values else None
        read = partial(read_disparity, scale=scale, encoding=values.get("encoding"))
    nonocc, calibration = (path.parent / values[key] if key in values else None for key in ("nonocc", "calibration"))
    return StereoEntry(
        name=values.get("name", Path(files[0]).with_suffix("").as_posix()),
        left=left,
        right=right,
        disparity=Source(truth[0], read) if truth else None,
        nonocc=Source(nonocc, read_nonocc_mask) if nonocc else None,
        calibration=Source(calibration, read_calibration) if calibration else None,
    )


def _by_stem(folder: Path) -> dict[str, Path]:
    """The files of a folder by their name without suffix; of several the first by `_SUFFIXES`."""
    files = [path for path in list_folder(folder) if path.suffix.lower() in _SUFFIXES]
    return {path.stem: path for path in sorted(files, key=lambda path: -_SUFFIXES.index(path.suffix.lower()))}


def _calibration(*folders: Path) -> Source[Calibration] | None:
    places = (folder / name for folder in folders for name in _CALIBRATION_NAMES)
    return next((Source(path, read_calibration) for path in places if path.is_file()), None)
