"""A sequence of image files."""

import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from stereokit.data.images import read_image
from stereokit.data.pairs import find_images
from stereokit.errors import printable
from stereokit.video.frames import Picture, Shot

__all__ = ["ImageSequence", "in_order"]


class ImageSequence:
    """Image files as the frames of a video.

    Args:
        paths: in order.
        rate: frames per second.
        name: what messages call it.
    """

    def __init__(self, paths: Sequence[Path], rate: float, name: str) -> None:
        self.paths = paths
        self.rate: float | None = rate
        self.name = name
        self.length: int | None = len(paths)
        self.counted = True
        self.damaged = 0
        self._step = 1 / rate

    @classmethod
    def at(cls, where: str | os.PathLike[str], rate: float) -> "ImageSequence":
        """The images of a folder or a pattern, in the order of their numbers.

        Raises:
            InputError: there are none.
        """
        found = find_images(where)
        return cls([found[name] for name in in_order(found)], rate, printable(where))

    def __iter__(self) -> Iterator[Shot]:
        """Every image.

        Raises:
            InputError: one can't be read.
        """
        for index, path in enumerate(self.paths):
            yield (Picture(read_image(path), index * self._step),)

    def close(self) -> None:
        """Nothing is held open."""


def in_order(names: "dict[str, Path] | Sequence[str]") -> list[str]:
    """Names by the numbers in them.

    >>> in_order(["frame10", "frame9", "frame1"])
    ['frame1', 'frame9', 'frame10']
    """
    return sorted(names, key=lambda name: [(int(part), "") if part.isdigit() else (-1, part) for part in _parts(name)])


def _parts(name: str) -> list[str]:
    return re.findall(r"[0-9]+|[^0-9]+", name)
