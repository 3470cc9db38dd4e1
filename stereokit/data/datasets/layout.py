"""How the data sets find their files, and what they say where they find others."""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from stereokit.data.datasets.dataset import StereoDataset, StereoEntry
from stereokit.data.images import IMAGE_SUFFIXES
from stereokit.errors import InputError, printable

__all__ = [
    "NoPairs",
    "check_choice",
    "check_number",
    "first_folder",
    "folders_below",
    "image_names",
    "images_by_stem",
    "images_in",
    "is_visible",
    "list_folder",
    "make_dataset",
    "scenes_of",
]


class NoPairs(InputError):
    """A place where no pair of the kind lies."""


def check_choice(what: str, given: str, allowed: Sequence[str]) -> str:
    """The choice, if it is an allowed one.

    Raises:
        InputError: it is not.
    """
    if given not in allowed:
        raise InputError(f"unknown {what} {given!r}; expected one of {', '.join(allowed)}")
    return given


def first_folder(candidates: Iterable[Path]) -> Path | None:
    """The first of the folders that is there."""
    return next((folder for folder in candidates if folder.is_dir()), None)


def list_folder(folder: Path) -> list[Path]:
    """The visible content of a folder, sorted by name; nothing where it is none."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def folders_below(root: Path, depth: int) -> list[Path]:
    """A folder and the visible ones below it, down to so many levels; nothing where it is none."""
    if not root.is_dir():
        return []
    below = [path for path in list_folder(root) if path.is_dir()] if depth else []
    return [root, *(folder for path in below for folder in folders_below(path, depth - 1))]


def images_in(folder: Path) -> list[Path]:
    """The image files in a folder, sorted by name."""
    return [path for path in list_folder(folder) if path.suffix.lower() in IMAGE_SUFFIXES]


def images_by_stem(folder: Path) -> dict[str, Path]:
    """The image files in a folder by their name without suffix; of several the last one by name."""
    return {path.stem: path for path in images_in(folder)}


def is_visible(path: Path, root: Path) -> bool:
    """Whether no part of the path below the root is hidden, as the `._` files of macOS are."""
    return not any(part.startswith(".") for part in path.relative_to(root).parts)


def image_names(left: Path, right: Path) -> list[str]:
    """The names of the images in either of two folders, sorted, so that a missing view is noticed."""
    return sorted({path.name for folder in (left, right) for path in images_in(folder)})


def scenes_of(folders: Iterable[Path]) -> list[Path]:
    """Those of the folders that hold `im0.png` or `im1.png`, so that a missing view is noticed."""
    return [folder for folder in folders if (folder / "im0.png").is_file() or (folder / "im1.png").is_file()]


def check_number(what: str, given: float | str) -> float:
    """A number, which may come as text from a command line.

    Raises:
        InputError: it is none.
    """
    try:
        return float(given)
    except ValueError:
        raise InputError(f"{what} must be a number, got {printable(str(given), most=40)}") from None


def make_dataset(
    kind: str,
    root: Path,
    split: str,
    entries: Sequence[StereoEntry],
    *,
    expected: Sequence[str],
    filled: Sequence[str] = (),
    passed_over: Sequence[str] = (),
    unused_truth: Sequence[str] = (),
) -> StereoDataset:
    """The data set of these entries.

    Args:
        kind: its name in `DATASETS`.
        root: where it was looked for.
        split: which part of it.
        entries: that were found.
        expected: files of the kind, for the message where none were found.
        filled: the splits that have pairs in the same files, where the kind shares them out by rule.
        passed_over: see `StereoDataset`.
        unused_truth: see `StereoDataset`.

    Raises:
        NoPairs: there are none, and the message shows the tree that was expected and the one that was found.
        InputError: two have one name, or the pairs are all of other splits.
    """
    if not entries and filled:
        raise InputError(
            f"split {split!r} of {kind} is empty in {printable(root)}; the pairs there are of split "
            f"{' or '.join(map(repr, filled))}"
        )
    if not entries:
        raise NoPairs(
            f"no pairs of {kind}, split {split!r}, in {printable(root)}: "
            f"expected {' or '.join(expected)}; found {_describe(root)}"
        )
    name, count = Counter(entry.name for entry in entries).most_common(1)[0]
    if count > 1:
        raise InputError(f"{count} pairs of {kind} in {printable(root)} have the name {printable(name)}; expected one")
    return StereoDataset(kind, root, split, entries, passed_over=passed_over, unused_truth=unused_truth)


def _describe(root: Path) -> str:
    if not root.exists():
        return "nothing, it does not exist"
    if not root.is_dir():
        return "a file"
    names = [printable(path.name, most=40, quoted=False) + "/" * path.is_dir() for path in list_folder(root)]
    names, left_out = names[:6], len(names[6:])
    return ", ".join(names) + (f" and {left_out} more" if left_out else "") if names else "an empty folder"
