"""`stereokit calibrate`."""

import argparse
import dataclasses
import sys
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, get_args

from tqdm import tqdm

from stereokit._version import __version__
from stereokit.cameras.calibrating import LEAST_VIEWS, RigCalibration, calibrate_rig
from stereokit.cameras.calibration_report import write_report
from stereokit.cameras.rig import Model
from stereokit.cameras.solving import COEFFICIENTS
from stereokit.cameras.views import FoundViews, ViewPair, find_views
from stereokit.cli.board import add_board_options, board_words, chosen_board
from stereokit.cli.views import Views, add_view_arguments, open_views
from stereokit.errors import ConfigError, InputError
from stereokit.files import check_folder, check_free
from stereokit.tables import counted

__all__ = ["add_arguments", "run"]

_FRAMES = 60  # of a video that are looked at by default
_EXAMPLES = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit calibrate`."""
    add_view_arguments(parser)
    add_board_options(parser)
    parser.add_argument("--model", choices=get_args(Model), default="pinhole", help="of the lenses (default: pinhole)")
    parser.add_argument(
        "--coefficients",
        type=int,
        choices=sorted(COEFFICIENTS),
        help="of the distortion of pinhole cameras (default: 4); more go astray where the board never was",
    )
    parser.add_argument(
        "--least-views", type=int, default=LEAST_VIEWS, metavar="N", help="to be kept (default: %(default)s)"
    )
    parser.add_argument(
        "--every", type=int, metavar="N", help=f"look at each Nth frame of a video (default: about {_FRAMES} in all)"
    )
    parser.add_argument(
        "--out", default="rig.json", help="file of the rig, beside which a report is written (default: %(default)s)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")


def run(options: argparse.Namespace) -> None:
    """Calibrates a rig, and says how good it is.

    Raises:
        StereoKitError: views that can't be read, too few that show the board, or cameras that make no rig.
    """
    board = chosen_board(options)
    rig_file, report_file = Path(options.out), Path(options.out).with_suffix(".html")
    if rig_file.suffix.lower() != ".json":
        raise InputError(f"{options.out!r}: a rig is written as .json")
    check_folder(rig_file.parent)
    if not rig_file.parent.is_dir():
        raise InputError(f"the folder {str(rig_file.parent)!r} does not exist; make it, or choose another --out")
    check_free([rig_file, report_file], overwrite=options.overwrite)
    views = open_views(options.left, options.right, options.layout)
    step = _step(views, options.every)
    found = find_views(board, lambda: _looked_at(views, step))
    found.check_enough(options.least_views)
    result = calibrate_rig(
        found.views,
        found.size,
        model=options.model,
        coefficients=4 if options.coefficients is None else options.coefficients,
        least_views=options.least_views,
    )
    result = dataclasses.replace(result, warnings=(*found.warnings, *result.warnings))
    examples = list(views.read(_example_names(result)))
    about = _about(options, found, result)
    result.rig.write(rig_file, about=about, overwrite=options.overwrite)
    write_report(report_file, result, found, examples, about, overwrite=options.overwrite)
    for line in _summary(found, result):
        print(line)
    for warning in result.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"wrote {rig_file} and {report_file}")


def _step(views: Views, every: int | None) -> int:
    """How many frames of a video to go on by."""
    if every is not None and not views.video:
        raise ConfigError("--every has no effect on images; leave it out")
    if every is not None and every < 1:
        raise ConfigError(f"--every is {every}; expected 1 or more")
    if not views.video:
        return 1
    return every or max(1, (views.length or 30 * _FRAMES) // _FRAMES)


def _looked_at(views: Views, step: int) -> Iterator[ViewPair]:
    total = None if views.length is None else -(-views.length // step)
    with tqdm(total=total, unit="pair", desc="looking for the board", disable=None) as bar:
        for index, pair in enumerate(views.read(None)):
            if index % step == 0:
                yield pair
                bar.update()


def _example_names(result: RigCalibration) -> set[str]:
    """The nearest view, the farthest, and one between."""
    near_to_far = [view.name for view in sorted(result.views, key=lambda view: view.distance)]
    last = len(near_to_far) - 1
    return {near_to_far[i * last // (_EXAMPLES - 1)] for i in range(_EXAMPLES)}


def _about(options: argparse.Namespace, found: FoundViews, result: RigCalibration) -> dict[str, Any]:
    return {
        "made": {
            "by": f"stereokit {__version__}",
            "at": datetime.now(timezone.utc).isoformat(timespec="seconds"),
            "arguments": options.arguments,
        },
        "board": {"kind": type(found.board).__name__, "options": board_words(found.board)},
        **result.to_dict(),
        "unused": found.unused,
    }


def _summary(found: FoundViews, result: RigCalibration) -> Iterator[str]:
    quality, rig = result.quality, result.rig
    looked = len(found.views) + len(found.unused)
    unused = f"; not used: {found.reasons}" if found.unused else ""
    yield f"{len(found.views)} of {counted(looked, 'pair')} show the board{unused}"
    if result.rejected:
        names = ", ".join(f"{name} ({error:.2f} px)" for name, error in result.rejected.items())
        yield f"rejected for their errors: {names}"
    yield (
        f"{counted(quality.views, 'view')} used: error {quality.rms:.3f} px; rows differ by {quality.epipolar_rms:.3f} "
        f"px, by {quality.held_out_rms:.3f} px in views held out"
    )
    yield (
        f"focal lengths {rig.left.fx:.1f} and {rig.right.fx:.1f} px, baseline {rig.baseline * 1e3:.2f} mm, board from "
        f"{quality.distances[0]:.2f} to {quality.distances[1]:.2f} m"
    )
