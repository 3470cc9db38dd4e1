"""`stereokit info`."""

import argparse

from stereokit.bench.summary import model_summary
from stereokit.cli.options import network_help
from stereokit.errors import InputError
from stereokit.weights.opening import load_network

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit info`."""
    parser.add_argument("model", help=network_help(bare_name="untrained"))
    parser.add_argument("--size", nargs=2, type=int, default=(384, 1248), metavar=("HEIGHT", "WIDTH"))


def run(options: argparse.Namespace) -> None:
    """Prints the table of blocks.

    Raises:
        StereoKitError: a network that can't be opened, or a size below the smallest.
    """
    model = load_network(options.model, bare_name="untrained")
    height, width = options.size
    least = model.least_size
    if min(height, width) < least:
        raise InputError(f"--size {height} {width} is below {least} x {least}, the smallest that the network takes")
    blocks = model_summary(model, height, width)
    parameters, multiply_adds = sum(b.parameters for b in blocks), sum(b.multiply_adds for b in blocks)
    config = model.config
    guidance = f"guidance {config['guidance']['name']} ({config['guidance_at']}), " if "guidance" in config else ""
    print(f"{config['name']}: max_disparity {model.max_disparity}, {guidance}one pair of {width} x {height} px")
    line = "{:15}  {:22}  {:27}  {:>12}  {:>10}".format
    print(line("slot", "block", "class", "parameters", "GMACs"))
    for block in blocks:
        gmacs = f"{block.multiply_adds / 1e9:.3f}"
        print(line(block.slot, block.name, block.kind, f"{block.parameters:,}", gmacs))
    print(line("total", "", "", f"{parameters:,}", f"{multiply_adds / 1e9:.3f}"))
