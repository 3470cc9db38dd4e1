"""`stereokit check`."""

import argparse
import json
from pathlib import Path

from stereokit.calibration import read_calibration
from stereokit.cameras.checking import check_pair, matches_picture
from stereokit.data.images import read_image, write_image
from stereokit.files import check_free

__all__ = ["add_arguments", "run"]

EXIT_CODES = {"good": 0, "warning": 1, "unusable": 2}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit check`."""
    parser.add_argument("left", help="left image")
    parser.add_argument("right", help="right image")
    parser.add_argument("--calibration", metavar="FILE", help="of the pair, to be checked against it")
    parser.add_argument(
        "--max-disparity", type=float, default=192, help="the largest that will be searched (default: %(default)s px)"
    )
    parser.add_argument("--json", action="store_true", help="print findings and measured numbers as JSON")
    parser.add_argument("--picture", metavar="FILE", help="write a picture of the matches over rows")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing picture")


def run(options: argparse.Namespace) -> int:
    """Prints what is wrong with a pair, and what to do.

    Returns:
        0 for a good pair, 1 for one with warnings, 2 for one that can't be matched.

    Raises:
        StereoKitError: files that can't be read or written.
    """
    if options.picture is not None:
        check_free([Path(options.picture)], overwrite=options.overwrite)
    calibration = None if options.calibration is None else read_calibration(options.calibration)
    views = read_image(options.left), read_image(options.right)
    found = check_pair(*views, calibration, options.max_disparity)
    if options.picture is not None:
        write_image(options.picture, matches_picture(found, *views), overwrite=options.overwrite)
    print(json.dumps(found.to_dict(), indent=2) if options.json else found)
    return EXIT_CODES[found.severity]
