"""Left and right image files that belong together, by name."""

import glob
import os
import re
from dataclasses import dataclass
from pathlib import Path

from stereokit.data.images import IMAGE_SUFFIXES
from stereokit.errors import InputError, printable
from stereokit.tables import counted

__all__ = ["ImagePair", "find_images", "match_pairs"]


@dataclass(frozen=True)
class ImagePair:
    """Two image files and the name of their pair."""

    name: str
    left: Path
    right: Path


def match_pairs(left: str | os.PathLike[str], right: str | os.PathLike[str]) -> list[ImagePair]:
    """Pairs of image files.

    Two files are one pair, named after the left one. In two folders, files of one name (suffix apart) are a pair. With
    two patterns, files are a pair where the wildcards stand for the same text: ``a/*_left.png`` and ``a/*_right.png``,
    or ``*/im0.png`` and ``*/im1.png``; the text is the pair's name.

    Args:
        left: a file, a folder, or a pattern with ``*``, ``?`` or ``**``.
        right: of the same kind.

    Raises:
        InputError: the two are of different kinds, nothing is found, or an image lacks its partner.

    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> for name in ("a_L.png", "b_L.png", "a_R.png", "b_R.png"):
    ...     (folder / name).touch()
    >>> [pair.name for pair in match_pairs(folder / "*_L.png", folder / "*_R.png")]
    ['a', 'b']
    """
    left, right = os.fspath(left), os.fspath(right)
    kinds = _kind(left), _kind(right)
    if kinds[0] != kinds[1]:
        raise InputError(
            f"{printable(left)} is a {kinds[0]} and {printable(right)} a {kinds[1]}; give two files, two folders or "
            "two patterns"
        )
    if kinds[0] == "file":
        for path in (left, right):
            if not os.path.exists(path):
                raise InputError(f"{printable(path)} does not exist")
        return [ImagePair(Path(left).stem, Path(left), Path(right))]
    lefts, rights = find_images(left), find_images(right)
    alone = [path for a, b in ((lefts, rights), (rights, lefts)) for key, path in a.items() if key not in b]
    if alone:
        shown = ", ".join(printable(path, most=60, quoted=False) for path in alone[:4])
        shown += f" and {len(alone) - 4} more" if len(alone) > 4 else ""
        raise InputError(
            f"{counted(len(alone), 'image')} without a partner of the same name on the other side: {shown}"
        )
    return [ImagePair(key or lefts[key].stem, lefts[key], rights[key]) for key in sorted(lefts)]


def find_images(where: str | os.PathLike[str]) -> dict[str, Path]:
    """The image files of a folder by their stem, or of a pattern by what its wildcards stand for, sorted.

    Raises:
        InputError: there are none, or two of one name.
    """
    where = os.fspath(where)
    found = _in_folder(where) if _kind(where) == "folder" else _by_pattern(where)
    if not found:
        raise InputError(f"no images found at {printable(where)}; expected {', '.join(sorted(IMAGE_SUFFIXES))} files")
    return found


def _kind(where: str) -> str:
    if os.path.isdir(where):
        return "folder"
    return "pattern" if glob.has_magic(where) and not os.path.exists(where) else "file"


def _in_folder(folder: str) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in sorted(Path(folder).iterdir()):
        if _is_image(path):
            _add(found, path.stem, path)
    return found


def _by_pattern(pattern: str) -> dict[str, Path]:
    found: dict[str, Path] = {}
    try:
        expression = re.compile(_to_regex(pattern.replace(os.sep, "/")))
    except re.error as error:
        raise InputError(f"the pattern {printable(pattern)} can't be understood: {error.msg}") from error
    for name in sorted(glob.glob(pattern, recursive=True)):
        path = Path(name)
        match = expression.fullmatch(name.replace(os.sep, "/"))
        if match and _is_image(path):
            texts = (text.strip("/").replace("/", "_") for text in match.groups())
            _add(found, "_".join(text for text in texts if text), path)
    return found


def _is_image(path: Path) -> bool:
    # hidden files are no images: macOS writes one, ._left.png, beside each on other systems' disks
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".") and path.is_file()


def _add(found: dict[str, Path], key: str, path: Path) -> None:
    if key in found:
        raise InputError(
            f"{printable(found[key])} and {printable(path)} both stand for {printable(key, most=40)}; name or order "
            "them apart"
        )
    found[key] = path


def _to_regex(pattern: str) -> str:
    """A regular expression with one group per wildcard."""
    tokens = re.split(r"(\*\*/|\*\*|\*|\?|\[[^\]]+\])", pattern)
    wild = {"**/": "((?:.*/)?)", "**": "(.*)", "*": "([^/]*)", "?": "([^/])"}

    def translate(token: str) -> str:
        if token.startswith("[") and token.endswith("]"):
            return f"({token.replace('[!', '[^', 1)})"
        return wild.get(token, re.escape(token))

    return "".join(translate(token) for token in tokens)
