"""Frames of both views, from one place or two."""

import math
import os
from collections.abc import Generator, Iterator, Sequence
from types import TracebackType
from typing import Any

from stereokit.data.images import IMAGE_SUFFIXES
from stereokit.data.pairs import match_pairs
from stereokit.errors import ConfigError, InputError
from stereokit.video.camera import Cameras
from stereokit.video.file import VideoFile
from stereokit.video.folder import ImageSequence, in_order
from stereokit.video.frames import Shot, Source, StereoFrame
from stereokit.video.layout import Layout, check_layout, split
from stereokit.video.newest import Newest
from stereokit.video.places import Place, find_place
from stereokit.video.stream import Stream

__all__ = ["StereoVideo", "open_stereo_video"]

FOLDER_RATE = 25.0
"""Frames per second that a folder is taken to have."""


class StereoVideo:
    """An iterator of `StereoFrame`s, and a context manager that closes what it reads.

    A file gives every frame. A live source gives its newest one whenever the next is asked for.

    Args:
        sources: one that gives two views, by `layout` or by two pictures at once; or one for each view.
        layout: of a single view that holds both.
        live: whether only the newest frame of each counts.
        stall_seconds: to wait for a frame of a live source.
        name: what files made of it are named after.

    Attributes:
        name: likewise.
        live: likewise.
        rate: frames per second, None where the source does not say.
        length: how many frames a file should have; None where it does not say, and for live sources.
        given: frames given so far.
    """

    def __init__(
        self, sources: Sequence[Source], *, layout: Layout | None, live: bool, stall_seconds: float, name: str
    ) -> None:
        self.name = name
        self.live = live
        self.rate = sources[0].rate
        self.length = sources[0].length
        self.given = 0
        self._sources = sources
        self._layout = layout
        self._newest = [Newest(source, stall_seconds) for source in sources] if live else []
        self._frames = self._read()

    @property
    def dropped(self) -> int:
        """Frames of a live source that were passed over, because a newer one was there before they were wanted."""
        return max((newest.dropped for newest in self._newest), default=0)

    @property
    def damaged(self) -> int:
        """Frames of a stream that did not arrive whole, and were left out."""
        return sum(source.damaged for source in self._sources)

    def __iter__(self) -> "StereoVideo":
        return self

    def __next__(self) -> StereoFrame:
        """The next frame.

        Raises:
            InputError: views of two sizes; a file that was cut off, or a view that ends before the other, after all
                frames that are whole; a live source that stalls or breaks off.
        """
        return next(self._frames)

    def __enter__(self) -> "StereoVideo":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Lets go of files and cameras. Frames that were given stay as they are."""
        self._frames.close()
        for opened in self._newest or self._sources:
            opened.close()

    def _read(self) -> Generator[StereoFrame, None, None]:
        starts: list[float] = []
        for shots in self._shots():
            pictures = [picture for shot in shots for picture in shot]
            times = [picture.time for picture in pictures]
            # arrivals are on one clock; each file has its own
            starts = starts or ([times[0]] * len(times) if self.live else times)
            left, *others = (picture.image for picture in pictures)
            if self._layout is not None:
                left, right = split(left, self._layout, self._sources[0].name)
            else:
                (right,) = others
            if left.shape != right.shape:
                (lh, lw), (rh, rw) = left.shape[:2], right.shape[:2]
                raise InputError(
                    f"the left view has {lw} x {lh} pixels, the right one {rw} x {rh}; a pair has one size"
                )
            since = [moment - start for moment, start in zip(times, starts, strict=True)]
            yield StereoFrame(left, right, self.given, since[0], since[-1] - since[0])
            self.given += 1

    def _shots(self) -> Iterator[tuple[Shot, ...]]:
        """A shot of every source, until one ends."""
        if self.live:
            yield from zip(*self._newest, strict=False)
            return
        ends = object()
        readers = [iter(source) for source in self._sources]
        while True:
            shots: list[Any] = [next(reader, ends) for reader in readers]
            ended = [source.name for source, shot in zip(self._sources, shots, strict=True) if shot is ends]
            if len(ended) == len(shots):
                return
            if ended:
                raise InputError(
                    f"{ended[0]} ends after {self.given:,} frames, the other view goes on; expected two views of one "
                    "length"
                )
            yield tuple(shots)


def open_stereo_video(
    left: str | os.PathLike[str],
    right: str | os.PathLike[str] | None = None,
    *,
    layout: Layout | None = None,
    stall_seconds: float = 10.0,
    rate: float | None = None,
    size: tuple[int, int] | None = None,
) -> StereoVideo:
    """Opens a stereo video, from one place that holds both views or from two.

    ======================  =====================================================================================
    a place                 is
    ======================  =====================================================================================
    `run.mp4`               a video file, of any kind that FFmpeg reads
    a folder, a pattern     images in the order of the numbers in their names; of two folders or patterns the files
                            of one name are a pair
    `camera:0`              a camera of this machine, by number, or by device: `camera:/dev/v4l/by-id/...`
    `rtsp://...`            a stream of the network; `rtmp`, `udp`, `srt`, `http` and their like too
    ======================  =====================================================================================

    Args:
        left: the left view, or both.
        right: the right view; None where `left` holds both.
        layout: how one place holds both views: "side-by-side" or "top-bottom".
        stall_seconds: to wait for a frame of a camera or a stream, before it is an error.
        rate: frames per second, to ask a camera for, or of a folder (25 by default).
        size: width and height to ask a camera for.

    Raises:
        InputError: a place that is not there or can't be read, a camera that is not there, a stream that does not
            answer, a live view beside one from a file, or views that differ in length or rate.
        ConfigError: a layout that is missing or has no effect, other options that have none, or PyAV is missing.

    >>> import tempfile
    >>> import numpy as np
    >>> from pathlib import Path
    >>> from stereokit.data import write_image
    >>> folder = Path(tempfile.mkdtemp())
    >>> for i in range(3):
    ...     write_image(folder / f"{i}.png", np.zeros((8, 20, 3), np.uint8))
    >>> with open_stereo_video(folder, layout="side-by-side", rate=10) as video:
    ...     [(frame.left.shape, frame.index, frame.time) for frame in video]
    [((8, 10, 3), 0, 0.0), ((8, 10, 3), 1, 0.1), ((8, 10, 3), 2, 0.2)]
    """
    places = [find_place(where) for where in (left, right) if where is not None]
    _check(places, layout, rate, size, stall_seconds)
    live = places[0].live
    opened: list[Source] = []
    try:
        for source in _sources(places, rate, size, stall_seconds):
            opened.append(source)
        if not live:
            _check_alike(opened)
    except BaseException:
        for source in opened:
            source.close()
        raise
    return StereoVideo(opened, layout=layout, live=live, stall_seconds=stall_seconds, name=places[0].stem)


def _sources(
    places: Sequence[Place], rate: float | None, size: tuple[int, int] | None, stall_seconds: float
) -> Iterator[Source]:
    if all(place.kind == "camera" for place in places):
        yield Cameras([place.where for place in places], size=size, rate=rate)
    elif len(places) == 2 and not {place.kind for place in places} - {"folder", "pattern"}:
        pairs = {pair.name: pair for pair in match_pairs(places[0].where, places[1].where)}
        ordered = [pairs[name] for name in in_order(list(pairs))]
        yield ImageSequence([pair.left for pair in ordered], rate or FOLDER_RATE, places[0].shown)
        yield ImageSequence([pair.right for pair in ordered], rate or FOLDER_RATE, places[1].shown)
    else:
        for place in places:
            if place.kind == "camera":
                yield Cameras([place.where], size=size, rate=rate)
            elif place.kind == "stream":
                yield Stream(place, stall_seconds)
            elif place.kind == "file":
                if os.path.splitext(place.where)[1].lower() in IMAGE_SUFFIXES:
                    raise InputError(f"{place.shown} is an image, no video; give two images, or a folder of frames")
                yield VideoFile(place.where)
            else:
                yield ImageSequence.at(place.where, rate or FOLDER_RATE)


def _check(
    places: Sequence[Place],
    layout: Layout | None,
    rate: float | None,
    size: tuple[int, int] | None,
    stall_seconds: float,
) -> None:
    """Refuses places that do not go together, and options that have no effect on them."""
    first, last = places[0], places[-1]
    if first.live != last.live:
        raise InputError(f"{first.shown} and {last.shown}: a live view has no partner in a file; give two of one kind")
    if layout is not None:
        check_layout(layout)
    if len(places) == 1 and layout is None:
        raise ConfigError(
            f"{first.shown} is one video; say layout='side-by-side' or 'top-bottom' (--layout) if it holds both views, "
            "or give the right one too"
        )
    if len(places) == 2 and layout is not None:
        raise ConfigError(f"layout={layout!r} has no effect on two videos; leave it out, or give one that holds both")
    if len(places) == 2 and first.where == last.where and first.kind == last.kind:
        raise InputError(f"{first.shown} is given for both views; give two, or one with a layout")
    kinds = {place.kind for place in places}
    if rate is not None and not kinds & {"camera", "folder", "pattern"}:
        raise ConfigError(f"rate={rate:g} has no effect on {first.shown}, which has its own; leave it out")
    if size is not None and "camera" not in kinds:
        raise ConfigError(f"size={size} has no effect on {first.shown}, which has its own; leave it out")
    for name, value in (("rate", rate), ("stall_seconds", stall_seconds)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ConfigError(f"{name} must be a positive number, got {value}")


def _check_alike(sources: Sequence[Source]) -> None:
    """Refuses two views that say themselves that they differ."""
    first, last = sources[0], sources[-1]
    if first.counted and last.counted and first.length != last.length:
        raise InputError(
            f"{first.name} has {first.length:,} frames, {last.name} {last.length:,}; expected two views of one length"
        )
    if first.rate and last.rate and abs(first.rate / last.rate - 1) > 0.01:
        raise InputError(
            f"{first.name} has {first.rate:g} frames a second, {last.name} {last.rate:g}; expected two views of "
            "one rate"
        )
