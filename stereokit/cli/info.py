"""`stereokit info`."""

import argparse

from stereokit.bench.summary import model_summary
from stereokit.cli.options import network_help
from stereokit.errors import ConfigError, InputError
from stereokit.model import MIN_SIZE, StereoModel
from stereokit.weights.opening import load_network

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit info`."""
    parser.add_argument("model", help=network_help(bare_name="untrained"))
    parser.add_argument("--size", nargs=2, type=int, default=(384, 1248), metavar=("HEIGHT", "WIDTH"))


def run(options: argparse.Namespace) -> None:
    """Prints the table of blocks.

    Raises:
        StereoKitError: a network that can't be opened or has no slots, or a size below the smallest.
    """
    model = load_network(options.model, bare_name="untrained")
    if not isinstance(model, StereoModel):
        raise ConfigError(f"model {options.model!r} is not made of slots: it has no table of blocks")
    height, width = options.size
    if min(height, width) < MIN_SIZE:
        raise InputError(f"--size {height} {width} is below {MIN_SIZE} x {MIN_SIZE}, the smallest that networks take")
    blocks = model_summary(model, height, width)
    parameters, multiply_adds = sum(b.parameters for b in blocks), sum(b.multiply_adds for b in blocks)
    config = model.config
    print(
        f"{config['name']}: max_disparity {config['max_disparity']}, guidance {config['guidance']['name']} "
        f"({config['guidance_at']}), one pair of {width} x {height} px"
    )
    line = "{:12}  {:22}  {:27}  {:>12}  {:>10}".format
    print(line("slot", "block", "class", "parameters", "GMACs"))
    for block in blocks:
        gmacs = f"{block.multiply_adds / 1e9:.3f}"
        print(line(block.slot, block.name, block.kind, f"{block.parameters:,}", gmacs))
    print(line("total", "", "", f"{parameters:,}", f"{multiply_adds / 1e9:.3f}"))
