"""`stereokit bag`."""

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from stereokit.cli.interrupts import finished_before_interrupt
from stereokit.cli.loading import load_predictor
from stereokit.cli.options import add_predictor_options, add_published_options, network_help
from stereokit.errors import ConfigError, InputError
from stereokit.files import check_folder
from stereokit.ros.bag import BagWriter, StereoBag, Topics
from stereokit.tables import counted

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit bag`."""
    parser.add_argument("bag", help="of ROS 1 or ROS 2, with rectified images")
    parser.add_argument("--left", required=True, metavar="TOPIC", help="images of the left view, raw or compressed")
    parser.add_argument("--right", required=True, metavar="TOPIC", help="of the right view")
    parser.add_argument("--left-info", default="", metavar="TOPIC", help="its camera_info (default: beside the images)")
    parser.add_argument("--right-info", default="", metavar="TOPIC", help="likewise")
    parser.add_argument("--out", default="disparity_bag", help="folder of the new ROS 2 bag (default: %(default)s)")
    parser.add_argument("--cloud", action="store_true", help="write point clouds too, in the frame of the left camera")
    parser.add_argument(
        "--tolerance", type=float, default=0.005, metavar="SECONDS",
        help="by which the stamps of a pair may differ (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument("--model", help="name of the network that the weights are of (default: coex)")
    parser.add_argument("--weights", help=f"{network_help(exported=True)} (default: those of --model)")
    add_published_options(parser)
    add_predictor_options(parser)


def run(options: argparse.Namespace) -> None:
    """Matches the pairs of a bag, and writes disparity, and clouds if asked for, into a new one.

    What was matched until Ctrl-C, or until a damaged message, is kept.

    Raises:
        StereoKitError: a bag or options that can't be used, or a bag that is damaged.
    """
    if not options.tolerance >= 0:
        raise ConfigError(f"--tolerance must be at least 0 seconds, got {options.tolerance}")
    if (options.min_disparity or 0) < 0:
        raise ConfigError(
            f"--min-disparity is {options.min_disparity}, but bags hold disparities from 0 on; give 0 or more"
        )
    check_folder(Path(options.out).parent)
    topics = Topics(options.left, options.right, options.left_info, options.right_info)
    with StereoBag(options.bag, topics, options.tolerance) as bag:
        predictor = load_predictor(options)
        pairs = 0
        try:
            with BagWriter(options.out) as written:
                for pair in tqdm(bag, total=bag.length, unit="pair"):
                    result = predictor(pair.left, pair.right)
                    with finished_before_interrupt():
                        written.add_disparity(result.disparity, pair)
                        if options.cloud:
                            written.add_cloud(result.point_cloud(pair.calibration, pair.left), pair)
                    pairs += 1
        finally:
            alone = " and ".join(f"{count} {side}" for side, count in bag.unpaired.items())
            if any(bag.unpaired.values()):
                print(f"{alone} images without a partner within {options.tolerance:g} s", file=sys.stderr)
            if pairs:
                print(f"{counted(pairs, 'pair')}; wrote {options.out}")
    if not pairs:
        raise InputError("no image has a partner of its time; is --tolerance too small, or are the clocks apart?")
