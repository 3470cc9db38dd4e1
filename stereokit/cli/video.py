"""Videos and cameras of `stereokit predict`."""

import argparse
import glob
import sys
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any, get_args

from tqdm import tqdm

from stereokit.cli.confidence import noise_warning
from stereokit.cli.depth import DepthFiles
from stereokit.cli.interrupts import finished_before_interrupt
from stereokit.cli.loading import load_predictor
from stereokit.errors import ConfigError
from stereokit.files import check_folder, check_free, make_folder
from stereokit.inference import DisparityResult, Predictor, match_video
from stereokit.pictures.colors import checked_range
from stereokit.tables import counted
from stereokit.video import Layout, StereoFrame, StereoVideo, is_video, open_stereo_video
from stereokit.video.colors import ColorVideoWriter
from stereokit.video.whole_numbers import DEPTH_SCALE, MapVideoWriter, fitting_scale

__all__ = ["add_video_options", "is_video_call", "run"]

EVERY = 30
"""Frames from one point cloud to the next."""

OF_VIDEOS = ("layout", "stall", "rate", "camera_size", "colors", "every", "frames", "disparity_scale")


def add_video_options(parser: argparse.ArgumentParser) -> None:
    """How videos and cameras are read, and what is written of them."""
    group = parser.add_argument_group(
        "videos and cameras", "video files, camera:0, rtsp://..., or with --layout one place for both views"
    )
    group.add_argument(
        "--layout", choices=get_args(Layout), help="of both views in LEFT; the left view is the left half, or the upper"
    )
    group.add_argument("--frames", type=int, metavar="N", help="end after so many (default: at the end, or at Ctrl-C)")
    group.add_argument(
        "--every", type=int, metavar="N", help=f"write the point cloud of every Nth frame (default: {EVERY})"
    )
    group.add_argument(
        "--colors",
        nargs=2,
        type=float,
        metavar=("LOW", "HIGH"),
        help="range of the colours in px (default: it follows the frames, slowly)",
    )
    group.add_argument(
        "--disparity-scale",
        type=float,
        metavar="S",
        help="the stored value of 1 px in the video of 16 bits (default: 256, or what the network's range needs)",
    )
    group.add_argument(
        "--rate", type=float, help="frames a second: to ask a camera for, or of a folder of images (default: 25)"
    )
    group.add_argument(
        "--camera-size", nargs=2, type=int, metavar=("WIDTH", "HEIGHT"), help="to ask a camera for (default: its own)"
    )
    group.add_argument(
        "--stall", type=float, metavar="SECONDS", help="to wait for a frame of a camera or stream (default: 10)"
    )


def is_video_call(options: argparse.Namespace) -> bool:
    """Whether the places that the options name are a video or a camera, and no pairs of images.

    Raises:
        ConfigError: they are pairs, and options are given that have no effect on them.
    """
    if options.right is None or is_video(options.left) or is_video(options.right):
        return True
    if options.layout is not None:
        raise ConfigError("--layout has no effect on two places; leave it out, or give one that holds both views")
    for name in OF_VIDEOS:
        if getattr(options, name) is not None:
            raise ConfigError(f"--{name.replace('_', '-')} has no effect on pairs of images; leave it out")
    return False


def run(options: argparse.Namespace) -> None:
    """Matches a video, and writes disparity, colours, and what else the options ask for.

    A live source ends at Ctrl-C, in order. Whatever ends it, the frames written are kept and whole.

    Raises:
        StereoKitError: options, a network or places that can't be used; or a video that does not end in order.
        KeyboardInterrupt: at Ctrl-C, of a file.
    """
    depth = DepthFiles.of(options)
    _check(options)
    check_folder(options.out)
    with _open(options) as video:
        files = VideoFiles(options, depth, video.name)
        check_free([*files.paths, *files.clouds_there()], overwrite=options.overwrite)
        predictor = load_predictor(options)
        try:
            files.open(predictor, None if video.live else video.rate)
            _match(predictor, video, files, options)
        except KeyboardInterrupt:
            if not video.live:
                raise
        finally:
            with finished_before_interrupt():
                files.close()
            for line in files.summary(video):
                tqdm.write(line)


def _open(options: argparse.Namespace) -> StereoVideo:
    given = {
        "layout": options.layout,
        "stall_seconds": options.stall,
        "rate": options.rate,
        "size": None if options.camera_size is None else tuple(options.camera_size),
    }
    return open_stereo_video(
        options.left, options.right, **{name: value for name, value in given.items() if value is not None}
    )


def _check(options: argparse.Namespace) -> None:
    for name in ("frames", "every"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ConfigError(f"--{name} must be at least 1, got {value}")
    if options.every is not None and options.cloud is None:
        raise ConfigError("--every has no effect without --cloud; leave it out, or add it")
    if options.depth not in (None, "png"):
        raise ConfigError(
            f"depth of a video is written as a video of 16 bits, in millimetres; say --depth alone, not {options.depth}"
        )
    if options.colors is not None:
        checked_range(options.colors)


def _match(predictor: Predictor, video: StereoVideo, files: "VideoFiles", options: argparse.Namespace) -> None:
    total = options.frames if video.live else min(filter(None, (video.length, options.frames)), default=None)
    with tqdm(total=total, unit="frame", file=sys.stderr) as bar:
        for frame, result in islice(match_video(predictor, video), options.frames):
            if not frame.index and (warning := noise_warning(video.name, result.mean_confidence)) is not None:
                tqdm.write(warning, file=sys.stderr)
            with finished_before_interrupt():
                files.add(frame, result, predictor)
            bar.update()
            if video.live:
                bar.set_postfix(dropped=video.dropped)


class VideoFiles:
    """The files made of a video.

    Args:
        options: of the command.
        depth: what depth and clouds are made of.
        name: what the files are named after.
    """

    def __init__(self, options: argparse.Namespace, depth: DepthFiles, name: str) -> None:
        self.options, self.depth = options, depth
        self._stem = Path(options.out) / name
        kinds = ["disparity.mkv", "picture.webm", *(["depth.mkv"] if options.depth is not None else [])]
        self.paths = [self._path(kind) for kind in kinds]
        self._frames = self._clouds = self._invalid = 0
        self._skew = self._seconds = 0.0
        self._size = (0, 0)
        self._device = ""
        self._disparity: MapVideoWriter | None = None
        self._colors: ColorVideoWriter | None = None
        self._metres: MapVideoWriter | None = None

    def clouds_there(self) -> list[Path]:
        """Clouds that a run before this one left under the same name."""
        pattern = glob.escape(self._stem.name) + f"_*_cloud.{self.options.cloud}"
        return sorted(self._stem.parent.glob(pattern)) if self.options.cloud is not None else []

    def open(self, predictor: Predictor, rate: float | None) -> None:
        """Begins the files, of so many frames a second.

        Raises:
            InputError: they can't be written.
            ConfigError: PyAV is not installed.
        """
        options = self.options
        make_folder(options.out)
        scale = options.disparity_scale or fitting_scale(largest_disparity(predictor))
        self._device = str(predictor.device)
        given: Any = {"rate": rate, "overwrite": options.overwrite}
        self._disparity = MapVideoWriter(self.paths[0], scale=scale, **given)
        self._colors = ColorVideoWriter(self.paths[1], value_range=options.colors, **given)
        if options.depth is not None:
            self._metres = MapVideoWriter(self.paths[2], kind="depth", scale=DEPTH_SCALE, **given)

    def add(self, frame: StereoFrame, result: DisparityResult, predictor: Predictor) -> None:
        """Writes what comes of a frame.

        Raises:
            InputError: a calibration of another size, a frame of another size than the first, or a full disk.
        """
        assert self._disparity is not None
        assert self._colors is not None
        metres = None
        with_cloud = self.options.cloud is not None and frame.index % (self.options.every or EVERY) == 0
        # before anything is written, because these may be refused
        if self._metres is not None or with_cloud:
            calibration = self.depth.calibration_of(result, predictor)
            left, valid = self.depth.views(result, frame.left, frame.right, predictor)
            metres = None if self._metres is None else self.depth.depth(calibration, result, valid)
        if with_cloud:
            cloud = self.depth.cloud(calibration, result, left, valid)
            path = self._path(f"{frame.index:06d}_cloud.{self.options.cloud}")
            cloud.write(path, overwrite=self.options.overwrite)
            self._clouds += 1
        self._disparity.write(result.disparity, frame.time)
        self._colors.write(result.disparity, frame.time)
        if self._metres is not None and metres is not None:
            self._metres.write(metres, frame.time)
        self._frames += 1
        self._invalid += result.invalid
        self._seconds += result.seconds
        self._skew = max(self._skew, abs(frame.skew))
        self._size = result.size

    def close(self) -> None:
        """Finishes the files."""
        with ExitStack() as stack:
            for writer in (self._disparity, self._colors, self._metres):
                if writer is not None:
                    stack.callback(writer.close)

    def summary(self, video: StereoVideo) -> list[str]:
        """What was done."""
        if self._disparity is None or not self._frames:
            return []
        height, width = self._size
        clouds = [f"{counted(self._clouds, 'point cloud')} {self._path(f'*_cloud.{self.options.cloud}')}"]
        written = [*map(str, self.paths), *(clouds if self._clouds else [])]
        lines = [
            f"{counted(self._frames, 'frame')} of {width} x {height} px, {self._seconds / self._frames:.2f} s each on "
            f"{self._device}; wrote {', '.join(written)} (1 px is {self._disparity.scale:g} in the disparity)"
        ]
        if video.live:
            lines.append(f"{counted(video.dropped, 'frame')} dropped, which came while others were matched")
        if video.damaged:
            lines.append(f"{counted(video.damaged, 'frame')} left out, which did not arrive whole")
        if self._skew:
            lines.append(f"left and right up to {1000 * self._skew:.0f} ms apart")
        if self._invalid:
            lines.append(f"{counted(self._invalid, 'pixel')} without a finite disparity")
        if self._disparity.lost:
            lines.append(
                f"{counted(self._disparity.lost, 'pixel')} unknown in the disparity of 16 bits, which holds 0 to "
                f"{65535 / self._disparity.scale:.1f} px; a smaller --disparity-scale holds more"
            )
        if self._metres is not None and self._metres.lost:
            lines.append(f"{counted(self._metres.lost, 'pixel')} of depth beyond 65.535 m, unknown in the file")
        return [f"{self._stem.name}: {line}" for line in lines]

    def _path(self, kind: str) -> Path:
        return self._stem.with_name(f"{self._stem.name}_{kind}")


def largest_disparity(predictor: Predictor) -> float:
    """What the network can find, in px of the frames; 0 where it does not say."""
    largest = getattr(getattr(predictor.backend, "network", None), "max_disparity", 0)
    return float(largest) / predictor.scale
