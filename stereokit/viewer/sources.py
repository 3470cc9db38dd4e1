"""Where the viewer's pairs come from: an album, in any order, or frames, one after the other."""

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

from stereokit.data.images import to_uint8
from stereokit.data.inputs import to_pair
from stereokit.data.pairs import ImagePair
from stereokit.errors import InputError, printable
from stereokit.inference import DisparityResult, output_paths
from stereokit.viewer.shot import Image

__all__ = ["Album", "Frame", "Frames", "Views", "find_results"]


class Views(NamedTuple):
    """A pair before it is matched, or with a result that was saved."""

    name: str
    left: Image
    right: Image
    result: DisparityResult | None = None


class Frame(Protocol):
    """What a video or a camera gives: both views, (H, W, 3), RGB, and a number that counts frames."""

    @property
    def left(self) -> Image:
        """The left view."""

    @property
    def right(self) -> Image:
        """The right view."""

    @property
    def index(self) -> int:
        """Frames given before this one."""


class Album:
    """Pairs of image files, any of which may be opened.

    Args:
        pairs: their files, at least one.
        results: of each pair a disparity file, where they are saved already; then nothing is matched.
    """

    def __init__(self, pairs: Sequence[ImagePair], results: Sequence[Path] | None = None) -> None:
        self.pairs = list(pairs)
        self.results = None if results is None else list(results)

    @property
    def names(self) -> list[str]:
        """Of the pairs."""
        return [pair.name for pair in self.pairs]

    def open(self, entry: int) -> Views:
        """Reads a pair.

        Raises:
            InputError: a file that can't be read, or a result of another size than the images.
        """
        pair = self.pairs[entry]
        left, right = (to_uint8(view[0].permute(1, 2, 0).numpy()) for view in to_pair(pair.left, pair.right))
        if self.results is None:
            return Views(pair.name, left, right)
        result = DisparityResult.read(self.results[entry])
        if result.size != left.shape[:2]:
            (height, width), (rows, columns) = result.size, left.shape[:2]
            raise InputError(
                f"{printable(self.results[entry])} is {width} x {height} pixels, the left image {columns} x {rows}; "
                "give the disparity of these images"
            )
        return Views(pair.name, left, right, result)


class Frames:
    """Frames of a video or a camera, one after the other.

    Args:
        frames: of one kind, such as `stereokit.video` gives; a live source gives its newest one.
        name: of the source.
        live: whether frames are lost that nobody asks for.
    """

    def __init__(self, frames: Iterable[Frame], *, name: str, live: bool) -> None:
        self._frames: Iterator[Frame] = iter(frames)
        self.name = name
        self.live = live

    def next(self) -> Views | None:
        """The next frame; None at the end.

        Raises:
            InputError: the source breaks off.
        """
        frame = next(self._frames, None)
        if frame is None:
            return None
        return Views(f"{self.name}, frame {frame.index}", to_uint8(frame.left), to_uint8(frame.right))


def find_results(place: str | os.PathLike[str], pairs: Sequence[ImagePair]) -> list[Path]:
    """The disparity file of each pair.

    Args:
        place: the file of a single pair; or a folder such as `stereokit predict` writes, where the files are named
            after the pairs: `NAME_disparity.npz`, `.pfm` or `.png`, or `NAME.npz` and so on.
        pairs: to be found.

    Raises:
        InputError: a pair without a result, or a file for several pairs.
    """
    folder = Path(place)
    if not folder.is_dir():
        if len(pairs) > 1:
            raise InputError(f"{printable(place)} is one file for {len(pairs)} pairs; give the folder of their results")
        if not folder.exists():
            raise InputError(f"{printable(place)} does not exist")
        return [folder]
    return [_result_of(pair.name, folder) for pair in pairs]


def _result_of(name: str, folder: Path) -> Path:
    png, pfm, npz, _ = output_paths(folder, name)
    # the most that is known first
    wanted = [npz, pfm, folder / f"{name}.npz", folder / f"{name}.npy", folder / f"{name}.pfm", png]
    found = next((path for path in wanted if path.is_file()), None)
    if found is None:
        raise InputError(f"no disparity of the pair {printable(name)} in {printable(folder)}; expected {npz.name!r}")
    return found
