"""One's own pairs: a folder of them, or a list file."""

import csv
import os
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from stereokit.calibration import Calibration, read_calibration
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
from stereokit.data.disparity_files import assumed_scale, read_disparity
from stereokit.data.images import IMAGE_SUFFIXES
from stereokit.errors import InputError, printable
from stereokit.files import read_file_bytes
from stereokit.registry import suggest

__all__ = ["folder"]

_SUFFIXES = (".pfm", ".npy", ".npz", *sorted(IMAGE_SUFFIXES))
_CALIBRATION_NAMES = ("calib.txt", "calib.yml", "calib.yaml")
_LIST_BYTES = 2**26
_TRUTH_LIKE = re.compile(r"disp|depth|truth|(^|[^a-z])gt([^a-z]|$)", re.IGNORECASE)
_KEY = re.compile(r"\w+=")
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
      list, in quotes where a name has blanks, with blanks or commas between them. After them `key=value` may follow,
      with `scale` or `encoding` (of `read_disparity`), `nonocc` (a mask, 255 where both cameras see), `calibration` (a
      file) and `name`. A `#` before a name begins a comment; before a blank, a quote or a `#` a backslash takes its
      meaning away. Other backslashes are those of Windows.

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
    truth = _TruthReader(None if scale is None else check_number("scale", scale), encoding)
    unused: list[str] = []
    if root.is_file():
        entries = list(_from_list(root, truth))
    elif (root / "left").is_dir():
        entries = list(_from_parallel_folders(root, truth))
        unused = [] if any(entry.disparity for entry in entries) else _truth_like(root, folders=True)
    else:
        scenes = [root, *list_folder(root)]
        found = {scene: entry for scene in scenes if (entry := _from_scene(scene, truth))}
        entries = list(found.values())
        unused = [f"{scene.name}/{name}" for scene, entry in found.items() for name in _unread_truth(scene, entry)]
    if unused:
        more = f" and {len(unused) - 1} more" if len(unused) > 1 else ""
        warnings.warn(
            f"what looks like ground truth is not read: {printable(unused[0])}{more}; name it disparity.* beside the "
            "images, give a list file, or open the data set by its own kind",
            stacklevel=2,
        )
    expected = ["left/*.png and right/*.png", "*/left.png and */right.png", "a list file"]
    return make_dataset("folder", root, split, entries, expected=expected, unused_truth=unused)


@dataclass(frozen=True)
class _TruthReader:
    """How ground truth is read, and which scale that takes for granted."""

    scale: float | None
    encoding: str | None

    def sources(self, path: Path | None) -> tuple[Source[Disparity] | None, Source[float | None] | None]:
        if path is None:
            return None, None
        read = Source(path, partial(read_disparity, scale=self.scale, encoding=self.encoding))
        told = self.scale is not None or self.encoding is not None
        return read, None if told else Source(path, assumed_scale)


def _unread_truth(scene: Path, entry: StereoEntry) -> list[str]:
    return [] if entry.disparity else _truth_like(scene)


def _truth_like(folder: Path, *, folders: bool = False) -> list[str]:
    """Names in a folder that sound like ground truth."""
    return [
        path.name
        for path in list_folder(folder)
        if _TRUTH_LIKE.search(path.stem) and (path.is_dir() if folders else path.suffix.lower() in _SUFFIXES)
    ]


def _from_parallel_folders(root: Path, reader: _TruthReader) -> Iterator[StereoEntry]:
    truth_folder = first_folder([root / "disparity" / "left", root / "disparity"])
    truths = _by_stem(truth_folder) if truth_folder else {}
    lefts, rights, masks = (_by_stem(root / part) for part in ("left", "right", "nonocc"))
    calibration = _calibration(root)
    for stem in sorted(lefts.keys() | rights.keys()):
        # A file that should be there and is not keeps its likely name, so that the error can say it.
        truth = truths.get(stem, truth_folder / f"{stem}.pfm") if truth_folder else None
        disparity, scale = reader.sources(truth)
        yield StereoEntry(
            name=stem,
            left=lefts.get(stem, root / "left" / f"{stem}.png"),
            right=rights.get(stem, root / "right" / f"{stem}.png"),
            disparity=disparity,
            assumed_scale=scale,
            nonocc=Source(masks[stem], read_nonocc_mask) if stem in masks else None,
            calibration=calibration,
        )


def _from_scene(scene: Path, reader: _TruthReader) -> StereoEntry | None:
    files = _by_stem(scene)
    if not {"left", "right"} & files.keys():
        return None
    disparity, scale = reader.sources(files.get("disparity"))
    return StereoEntry(
        name=scene.resolve().name,
        left=files.get("left", scene / "left.png"),
        right=files.get("right", scene / "right.png"),
        disparity=disparity,
        assumed_scale=scale,
        nonocc=Source(files["nonocc"], read_nonocc_mask) if "nonocc" in files else None,
        calibration=_calibration(scene, scene.parent),
    )


def _from_list(path: Path, reader: _TruthReader) -> Iterator[StereoEntry]:
    data = read_file_bytes(path, _LIST_BYTES + 1)
    if len(data) > _LIST_BYTES:
        raise InputError(f"{printable(path)} is no list of pairs: it has more than {_LIST_BYTES} bytes")
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{printable(path)} is no list of pairs: it is not UTF-8 text ({error.reason})") from error
    for number, line in enumerate(lines, start=1):
        try:
            words = _words(line)
            if words and "," in line and not os.path.exists(_file(path.parent, words[0])):
                row = next(csv.reader([re.sub(r"(^|\s)#.*", "", line)], skipinitialspace=True))
                words = [word.strip() for word in row if word.strip()]
        except (ValueError, csv.Error) as error:
            raise InputError(f"{printable(path)}, line {number}: {error}") from error
        if words:
            yield _from_line(path, number, words, reader)


def _words(line: str) -> list[str]:
    """The words of a line, split at blanks outside quotes, without its comment.

    Raises:
        ValueError: a quotation that does not end.

    >>> _words("'my data/left.png' seq#3/right.png name=it's\\\\ mine  # why not")
    ['my data/left.png', 'seq#3/right.png', "name=it's mine"]
    """
    words: list[str] = []
    word, quote, at = "", "", 0
    begun = False
    while at < len(line):
        sign, following = line[at], line[at + 1 : at + 2]
        at += 1
        if sign == "\\" and following and (following in "\"'#" or following.isspace()) and quote != "'":
            word, begun, at = word + following, True, at + 1
        elif sign == quote:
            quote = ""
        elif quote:
            word += sign
        elif sign in "\"'" and (not begun or word.endswith("=")):
            quote, begun = sign, True
        elif sign.isspace():
            words += [word] if begun else []
            word, begun = "", False
        elif sign == "#" and not begun:
            break
        else:
            word, begun = word + sign, True
    if quote:
        raise ValueError(f"the quotation mark {quote} is not closed; put a backslash before it if it belongs to a name")
    return [*words, word] if begun else words


def _file(folder: Path, name: str) -> Path:
    """A file of a list, whose backslashes may be those of Windows."""
    path = folder / name  # which may be too long for the system: os.path answers, pathlib raises
    return folder / name.replace("\\", "/") if "\\" in name and not os.path.exists(path) else path


def _from_line(path: Path, number: int, words: list[str], reader: _TruthReader) -> StereoEntry:
    where = f"{printable(path)}, line {number}"
    # a name may hold "=" too
    files = [word for word in words if not _KEY.match(word) or os.path.exists(_file(path.parent, word))]
    values = dict(word.split("=", 1) for word in words if word not in files)
    if len(files) not in (2, 3):
        raise InputError(
            f"{where}: expected a left image, a right image and perhaps disparity, got {len(files)} files; names with "
            "blanks stand in quotes"
        )
    for key in values:
        if key not in _LINE_KEYS:
            raise InputError(f"{where}: unknown {printable(key, most=40)}; {suggest(key[:40], list(_LINE_KEYS))}")
    left, right, *truth = (_file(path.parent, name) for name in files)
    if values.keys() & {"scale", "encoding"}:
        scale = check_number(f"{where}: scale", values["scale"]) if "scale" in values else None
        reader = _TruthReader(scale, values.get("encoding"))
    disparity, assumed = reader.sources(truth[0] if truth else None)
    nonocc, calibration = (
        _file(path.parent, values[key]) if key in values else None for key in ("nonocc", "calibration")
    )
    return StereoEntry(
        name=values.get("name", Path(files[0].replace("\\", "/")).with_suffix("").as_posix()),
        left=left,
        right=right,
        disparity=disparity,
        assumed_scale=assumed,
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
