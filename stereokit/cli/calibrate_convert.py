"""`stereokit calibrate convert`."""

import argparse

from stereokit.calibration import read_calibration, write_calibration
from stereokit.calibration.files import WRITERS
from stereokit.cameras.rig import is_rig, read_rig
from stereokit.cli.board import UNITS
from stereokit.errors import ConfigError

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit calibrate convert`."""
    parser.add_argument("file", help="calibration of a rectified pair, in any format that is known; or a rig")
    parser.add_argument("out", help="file to write; of kind ros its name says left or right, and both are written")
    parser.add_argument(
        "--kind", choices=sorted(WRITERS), help="of the new file (default: stereokit for .json, opencv for .yml, .xml)"
    )
    parser.add_argument(
        "--unit", choices=sorted(UNITS), help="of the baseline in FILE (default: that of its format; OpenCV's has none)"
    )
    parser.add_argument(
        "--size", nargs=2, type=int, metavar=("HEIGHT", "WIDTH"), help="of the images, where FILE does not say it"
    )
    parser.add_argument(
        "--scale-to", nargs=2, type=int, metavar=("HEIGHT", "WIDTH"), help="the size to which the images were resized"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")


def run(options: argparse.Namespace) -> None:
    """Writes a calibration, or a rig, in another format, or for images that were resized.

    Raises:
        StereoKitError: a file that can't be read or written, another aspect ratio, or options that have no effect.
    """
    if is_rig(options.file):
        for name in ("kind", "unit", "size"):
            if getattr(options, name) is not None:
                raise ConfigError(f"--{name} has no effect on a rig, which says all itself; leave it out")
        rig = read_rig(options.file)
        if options.scale_to is not None:
            rig = rig.scaled(height=options.scale_to[0], width=options.scale_to[1])
        rig.write(options.out, overwrite=options.overwrite)
        print(f"wrote {options.out}, a rig for images of {rig.left.width} x {rig.left.height} px")
        return
    unit = None if options.unit is None else UNITS[options.unit]
    calibration = read_calibration(options.file, metres_per_unit=unit)
    if options.size is not None:
        if calibration.width is not None:
            raise ConfigError("--size has no effect on a file that says it; leave it out, or say --scale-to")
        calibration = calibration.sized(*options.size)
    if options.scale_to is not None:
        if calibration.width is None:
            raise ConfigError(f"{options.file!r} does not say the size of its images; give it with --size")
        calibration = calibration.scaled(height=options.scale_to[0], width=options.scale_to[1])
    write_calibration(options.out, calibration, kind=options.kind, overwrite=options.overwrite)
    size = "" if calibration.width is None else f" for images of {calibration.width} x {calibration.height} px,"
    print(
        f"wrote {options.out},{size} focal length {calibration.fx:.6g} px, baseline {calibration.baseline * 1e3:.6g} mm"
    )
