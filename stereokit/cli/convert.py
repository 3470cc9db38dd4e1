"""`stereokit convert`."""

import argparse
from pathlib import Path

from stereokit.cli.options import add_published_options
from stereokit.files import check_folder, check_free
from stereokit.weights.folder import CONFIG_NAME, WEIGHTS_NAME
from stereokit.weights.published import convert_published, published_networks

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit convert`."""
    parser.add_argument("checkpoint", help="Lightning checkpoint or bare state dict")
    parser.add_argument("out", help="folder for the network")
    names = ", ".join(published_networks())
    parser.add_argument("--model", help=f"its network, {names} (default: the one whose weights these are)")
    add_published_options(parser)
    parser.add_argument("--overwrite", action="store_true", help="replace an existing network")


def run(options: argparse.Namespace) -> None:
    """Saves the network and prints what became of the checkpoint's keys.

    Raises:
        StereoKitError: a checkpoint or a folder that can't be used; then nothing is written.
    """
    check_folder(options.out)
    check_free([Path(options.out) / name for name in (CONFIG_NAME, WEIGHTS_NAME)], overwrite=options.overwrite)
    overrides = {} if options.top_k is None else {"top_k": options.top_k}
    model, report = convert_published(options.checkpoint, options.model, options.channel_order, **overrides)
    model.save_pretrained(options.out)
    regression = f"; regression {model.config['regression']}" if "regression" in model.config else ""
    print(f"{report}\nwrote {options.out} ({report.network}, from {report.channel_order.upper()}{regression})")
