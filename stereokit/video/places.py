"""Where frames come from, as a user names it."""

import glob
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from stereokit.errors import InputError, printable

__all__ = ["VIDEO_SUFFIXES", "Place", "find_place", "is_video"]

VIDEO_SUFFIXES = frozenset(
    ".mp4 .m4v .mov .mkv .webm .avi .mpg .mpeg .ts .mts .m2ts .wmv .flv .ogv .y4m .mjpg .mjpeg .h264 .hevc".split()  # noqa: SIM905
)
"""Of the files that are taken for videos."""

_SCHEMES = {"rtsp", "rtsps", "rtmp", "rtmps", "rtp", "udp", "srt", "tcp", "http", "https"}


@dataclass(frozen=True)
class Place:
    """A place and its kind.

    Attributes:
        kind: what is there.
        where: the camera's number or device, the address, or the path.
        shown: as messages say it, without the password of an address.
        stem: what files made of it are named after.
    """

    kind: Literal["camera", "stream", "file", "folder", "pattern"]
    where: str
    shown: str
    stem: str

    @property
    def live(self) -> bool:
        """Whether frames come as time goes by, and are lost if nobody takes them."""
        return self.kind in ("camera", "stream")


def find_place(where: str | os.PathLike[str]) -> Place:
    """What a user's word means: `camera:0`, `camera:/dev/...`, an address such as `rtsp://...`, or a path.

    Raises:
        InputError: a camera without number or device, or a path where nothing is.

    >>> find_place("camera:1").kind, find_place("rtsp://me:secret@robot/left").shown
    ('camera', "'rtsp://robot/left'")
    """
    text = os.fspath(where)
    if text.startswith("camera:"):
        device = text.removeprefix("camera:")
        if not re.fullmatch(r"\d+|/.+", device):
            raise InputError(f"{printable(text)} names no camera; expected a number or a device, such as camera:0")
        return Place("camera", device, printable(text), f"camera_{Path(device).name}")
    if _is_address(text):
        parts = urlsplit(text)
        host = parts.netloc.rpartition("@")[2]
        stem = re.sub(r"\W+", "_", f"{host}{parts.path}").strip("_")
        return Place("stream", text, printable(f"{parts.scheme}://{host}{parts.path}"), stem or parts.scheme)
    if os.path.isdir(text):
        return Place("folder", text, printable(text), Path(text).resolve().name)
    if os.path.exists(text):
        return Place("file", text, printable(text), Path(text).stem)
    if glob.has_magic(text):
        return Place("pattern", text, printable(text), Path(text).parent.name or "frames")
    raise InputError(f"{printable(text)} does not exist")


def is_video(where: str | os.PathLike[str]) -> bool:
    """Whether a place is a camera, a stream, or a file that is named like a video.

    >>> is_video("camera:0"), is_video("run.MP4"), is_video("left.png")
    (True, True, False)
    """
    text = os.fspath(where)
    return text.startswith("camera:") or _is_address(text) or Path(text).suffix.lower() in VIDEO_SUFFIXES


def _is_address(text: str) -> bool:
    scheme, mark, _ = text.partition("://")
    return bool(mark) and scheme.lower() in _SCHEMES
