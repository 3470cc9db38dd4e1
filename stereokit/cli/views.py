"""Pairs of views as commands are given them: images, folders, patterns, videos, or both views in one picture."""

import argparse
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from stereokit.cameras.views import ViewPair
from stereokit.data.images import read_image
from stereokit.data.pairs import find_images, match_pairs
from stereokit.errors import ConfigError, InputError
from stereokit.video import Layout, is_video, open_stereo_video
from stereokit.video.layout import split

__all__ = ["Views", "add_view_arguments", "open_views"]


def add_view_arguments(parser: argparse.ArgumentParser) -> None:
    """The places of both views."""
    parser.add_argument("left", help="left image, folder, quoted pattern or video; or what holds both views")
    parser.add_argument("right", nargs="?", help="the right one; left out where the first holds both")
    parser.add_argument("--layout", choices=get_args(Layout), help="of what holds both views in one picture")


@dataclass(frozen=True)
class Views:
    """Pairs of views, in order, as often as one likes.

    Attributes:
        read: gives them, from the first one; all, or those of these names alone.
        names: of image pairs; none of a video.
        length: how many pairs there are, None where a video does not say.
    """

    read: Callable[[Collection[str] | None], Iterator[ViewPair]]
    names: tuple[str, ...]
    length: int | None

    @property
    def video(self) -> bool:
        """Whether they are frames of a video."""
        return not self.names


def open_views(left: str, right: str | None, layout: Layout | None) -> Views:
    """Finds the views. Each pair has a name: that of its files, or "frame 120".

    Raises:
        InputError: nothing is there, views without a partner, or a live source.
        ConfigError: a layout that is missing or has no effect.
    """
    if is_video(left) or (right is not None and is_video(right)):
        with open_stereo_video(left, right, layout=layout) as video:
            if video.live:
                raise InputError(f"{left!r} is a live source; record it to a file first")
            length = video.length
        return Views(lambda names: _frames(left, right, layout, names), (), length)
    if right is None:
        if layout is None:
            raise ConfigError(
                f"{left!r} is given alone; say --layout side-by-side or top-bottom if it holds both views, or give the "
                "right one too"
            )
        files = {Path(left).stem: Path(left)} if Path(left).is_file() else find_images(left)
        return Views(lambda names: _halves(files, layout, names), tuple(files), len(files))
    if layout is not None:
        raise ConfigError(f"--layout {layout} has no effect on two places; leave it out, or give one that holds both")
    pairs = {pair.name: (pair.left, pair.right) for pair in match_pairs(left, right)}
    return Views(lambda names: _files(pairs, names), tuple(pairs), len(pairs))


def _files(pairs: dict[str, tuple[Path, Path]], names: Collection[str] | None) -> Iterator[ViewPair]:
    for name, (left, right) in pairs.items():
        if names is None or name in names:
            yield ViewPair(name, read_image(left), read_image(right))


def _halves(files: dict[str, Path], layout: Layout, names: Collection[str] | None) -> Iterator[ViewPair]:
    for name, path in files.items():
        if names is None or name in names:
            yield ViewPair(name, *split(read_image(path), layout, f"{str(path)!r}"))


def _frames(left: str, right: str | None, layout: Layout | None, names: Collection[str] | None) -> Iterator[ViewPair]:
    with open_stereo_video(left, right, layout=layout) as video:
        for frame in video:
            name = f"frame {frame.index}"
            if names is None or name in names:
                yield ViewPair(name, frame.left, frame.right)
