"""`stereokit rectify`."""

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from stereokit.calibration import write_calibration
from stereokit.cameras.rectification import Rectification, rectify
from stereokit.cameras.rig import read_rig
from stereokit.cli.interrupts import finished_before_interrupt
from stereokit.cli.views import Views, add_view_arguments, open_views
from stereokit.data.images import write_image
from stereokit.errors import InputError
from stereokit.files import check_folder, check_free, make_folder
from stereokit.tables import counted
from stereokit.video import open_stereo_video
from stereokit.video.writing import FFV1, VideoWriter

__all__ = ["add_arguments", "run"]

_CALIBRATION, _MASK = "calibration.json", "valid.png"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit rectify`."""
    add_view_arguments(parser)
    parser.add_argument("--rig", required=True, metavar="FILE", help="of 'stereokit calibrate', or Kalibr's camchain")
    parser.add_argument(
        "--field-of-view",
        type=float,
        metavar="DEGREES",
        help="horizontal, of the rectified views (default: all that --alpha says; 90 for fisheye)",
    )
    parser.add_argument(
        "--alpha",
        type=float,
        default=0.0,
        help="0 shows only what was seen, 1 all that was seen, with black borders (default: %(default)g)",
    )
    parser.add_argument("--out", default="rectified", help="folder for the results (default: %(default)s)")
    parser.add_argument("--overwrite", action="store_true", help="replace existing results")


def run(options: argparse.Namespace) -> None:
    """Rectifies views, and writes the calibration of the rectified pair and the mask of what both cameras saw.

    Raises:
        StereoKitError: a rig or views that can't be used; of several pairs of images the others are still written.
    """
    rectification = rectify(read_rig(options.rig), field_of_view=options.field_of_view, alpha=options.alpha)
    views = open_views(options.left, options.right, options.layout)
    check_folder(options.out)
    out = Path(options.out)
    check_free([out / _CALIBRATION, out / _MASK], overwrite=options.overwrite)
    if views.video:
        _write_videos(options, rectification, out)
        return
    count, failed = _write_images(views, rectification, out, options.overwrite)
    if count:
        _conclude(rectification, out, count, options.overwrite)
    if failed:
        raise InputError(f"{len(failed)} of {count + len(failed)} pairs could not be rectified: {', '.join(failed)}")


def _write_images(views: Views, rectification: Rectification, out: Path, overwrite: bool) -> tuple[int, list[str]]:
    """How many pairs were written, and the names of those that can't be used."""
    names = list(views.names)
    check_free([out / side / f"{name}.png" for name in names for side in ("left", "right")], overwrite=overwrite)
    failed = []
    for name in tqdm(names, unit="pair", disable=None if len(names) > 1 else True):
        try:
            ((_, left, right),) = views.read({name})
            rectified = rectification(left, right)
        except InputError as error:
            if len(names) == 1:
                raise
            failed.append(name)
            tqdm.write(f"{name}: {error}", file=sys.stderr)
            continue
        for side, view in zip(("left", "right"), rectified, strict=True):
            make_folder(out / side)
            write_image(out / side / f"{name}.png", view, overwrite=overwrite)
    return len(names) - len(failed), failed


def _write_videos(options: argparse.Namespace, rectification: Rectification, out: Path) -> None:
    """Two lossless videos, of 16 bits where the views have more than 8. Whatever ends them, they are kept and whole."""
    paths = [out / f"{side}.mkv" for side in ("left", "right")]
    check_free(paths, overwrite=options.overwrite)
    count = 0
    try:
        with open_stereo_video(options.left, options.right, layout=options.layout) as video, ExitStack() as stack:
            writers: list[VideoWriter] = []
            for frame in tqdm(video, total=video.length, unit="frame", disable=None):
                pair = rectification(frame.left, frame.right)
                with finished_before_interrupt():
                    if not writers:
                        make_folder(out)
                        writers = [
                            stack.enter_context(_writer(path, view, video.rate, overwrite=options.overwrite))
                            for path, view in zip(paths, pair, strict=True)
                        ]
                    for writer, view in zip(writers, pair, strict=True):
                        if view.dtype == np.uint8:
                            writer.write(view, "rgb24", frame.time)
                        else:
                            writer.write(np.rint(view * 65535).astype(np.uint16), "rgb48le", frame.time)
                    count += 1
    finally:
        if count:
            with finished_before_interrupt():
                _conclude(rectification, out, count, options.overwrite)


def _writer(path: Path, view: npt.NDArray[Any], rate: float | None, *, overwrite: bool) -> VideoWriter:
    pixels = "bgr0" if view.dtype == np.uint8 else "gbrp16le"
    return VideoWriter(path, codec="ffv1", pixels=pixels, options=FFV1, tags={}, rate=rate, overwrite=overwrite)


def _conclude(rectification: Rectification, out: Path, count: int, overwrite: bool) -> None:
    """Writes what is the same of all pairs, and says what was done."""
    camera = rectification.calibration
    write_calibration(out / _CALIBRATION, camera, overwrite=overwrite)
    seen = np.where(rectification.valid, np.uint8(255), np.uint8(0))
    write_image(out / _MASK, np.repeat(seen[:, :, None], 3, axis=2), overwrite=overwrite)
    print(
        f"{counted(count, 'pair')} rectified into {out}: focal length {camera.fx:.1f} px, baseline "
        f"{camera.baseline * 1e3:.2f} mm, {rectification.valid.mean():.0%} seen by both; wrote {out / _CALIBRATION}"
    )
