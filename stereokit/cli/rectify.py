"""`stereokit rectify`."""

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from stereokit.calibration import write_calibration
from stereokit.cameras.rectification import Rectification, rectify
from stereokit.cameras.rig import read_rig
from stereokit.cli.views import Views, add_view_arguments, open_views
from stereokit.data.images import to_uint8, write_image
from stereokit.errors import InputError
from stereokit.files import atomic_path, check_folder, check_free, make_folder
from stereokit.tables import counted

__all__ = ["add_arguments", "run"]


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
    calibration, mask = out / "calibration.json", out / "valid.png"
    check_free([calibration, mask], overwrite=options.overwrite)
    write = _write_videos if views.video else _write_images
    count, failed = write(views, rectification, out, options.overwrite)
    if count:
        write_calibration(calibration, rectification.calibration, overwrite=options.overwrite)
        seen = np.where(rectification.valid, np.uint8(255), np.uint8(0))
        write_image(mask, np.repeat(seen[:, :, None], 3, axis=2), overwrite=options.overwrite)
        camera = rectification.calibration
        print(
            f"{counted(count, 'pair')} rectified into {out}: focal length {camera.fx:.1f} px, baseline "
            f"{camera.baseline * 1e3:.2f} mm, {rectification.valid.mean():.0%} seen by both; wrote {calibration}"
        )
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


def _write_videos(views: Views, rectification: Rectification, out: Path, overwrite: bool) -> tuple[int, list[str]]:
    """Two lossless videos, which appear when both are whole."""
    paths = [out / f"{side}.mkv" for side in ("left", "right")]
    check_free(paths, overwrite=overwrite)
    made = not out.exists()
    make_folder(out)
    count = 0
    try:
        with ExitStack() as stack:
            temporary = [stack.enter_context(atomic_path(path, overwrite=overwrite)) for path in paths]
            writers = [_writer(path, rectification, views.rate) for path in temporary]
            try:
                for _, *pair in tqdm(views.read(None), total=views.length, unit="frame", disable=None):
                    for writer, view in zip(writers, rectification(pair[0], pair[1]), strict=True):
                        writer.write(_bgr(view))
                    count += 1
            finally:
                for writer in writers:
                    writer.release()
    except BaseException:
        if made:
            out.rmdir()
        raise
    return count, []


def _writer(path: Path, rectification: Rectification, rate: float | None) -> cv2.VideoWriter:
    height, width = rectification.left_valid.shape
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"FFV1"), rate or 25.0, (width, height))
    if not writer.isOpened():
        raise InputError(f"{str(path)!r} can't be written as a video; this build of OpenCV has no FFV1")
    return writer


def _bgr(view: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
    return np.ascontiguousarray(to_uint8(view)[:, :, ::-1])
