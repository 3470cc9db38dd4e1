"""Options that several commands share."""

import argparse
from typing import get_args

from stereokit.backends import BACKENDS
from stereokit.inference.bounds import TooLarge
from stereokit.runtime.precision import DTYPES
from stereokit.weights.opening import BareName

__all__ = [
    "DEVICE_HELP",
    "add_bit_depth_option",
    "add_iterations_option",
    "add_predictor_options",
    "add_published_options",
    "network_help",
]

DEVICE_HELP = "cpu, cuda, ... (default: a GPU if there is one)"


def network_help(*, exported: bool = False, bare_name: BareName = "trained") -> str:
    """What `--weights` and its like take, see `stereokit.open_network`.

    Args:
        exported: whether the command takes exported files too.
        bare_name: what the name of a network stands for.
    """
    files = ", exported file (.onnx, .xml)" if exported else ""
    meaning = "for its default weights" if bare_name == "trained" else "with random weights"
    return (
        f"folder or hub id of a saved network, published checkpoint{files}, name of weights (see 'stereokit list "
        f"weights'), or name of a network, {meaning}"
    )


def add_published_options(parser: argparse.ArgumentParser) -> None:
    """What the weights of a published checkpoint can't tell."""
    parser.add_argument(
        "--channel-order",
        choices=("bgr", "rgb"),
        help="of the images that a published checkpoint was trained on (default: bgr, as the authors')",
    )
    parser.add_argument("--top-k", type=int, metavar="K", help="candidates that its regression keeps (default: coex 2)")


def add_iterations_option(parser: argparse.ArgumentParser) -> None:
    """How long a recurrent network works on a pair."""
    parser.add_argument(
        "--iterations",
        type=int,
        metavar="N",
        help="of networks that mend a disparity in rounds, such as raft_stereo and igev (default: the network's own)",
    )


def add_predictor_options(parser: argparse.ArgumentParser) -> None:
    """What runs the network, and how large pairs are matched, see `stereokit.Predictor`."""
    add_iterations_option(parser)
    parser.add_argument("--device", default="auto", help=DEVICE_HELP)
    parser.add_argument(
        "--backend", default="auto", help=f"{', '.join(BACKENDS)} (default: torch, or that of an exported file)"
    )
    parser.add_argument(
        "--precision",
        metavar="NAME",
        help=f"{', '.join(DTYPES)} for the arithmetic (default: float32, or that of an exported file)",
    )
    parser.add_argument(
        "--max-memory", metavar="SIZE", help="that a pair may take, such as 4GiB (default: what is free)"
    )
    parser.add_argument(
        "--too-large",
        choices=get_args(TooLarge),
        help="what becomes of a pair that needs more: refused (default), matched in tiles, or at a reduced resolution",
    )
    parser.add_argument(
        "--scale",
        type=float,
        help="match at this part of the resolution, at most 8: 0.5 finds disparities twice as large and less detail, 2 "
        "finer detail and disparities half as large (default: 1)",
    )
    parser.add_argument(
        "--min-disparity",
        type=int,
        metavar="PX",
        help="the smallest disparity that is looked for, such as -32 for cameras that are toed in (default: 0)",
    )


def add_bit_depth_option(parser: argparse.ArgumentParser) -> None:
    """What images of 16 bits per sample do not tell."""
    parser.add_argument(
        "--bit-depth",
        type=int,
        metavar="BITS",
        help="of the cameras, where images of 16 bits hold fewer: 12 for values up to 4095",
    )
