"""`stereokit export`."""

import argparse

from torch import nn

from stereokit.cli.loading import load_chosen_network
from stereokit.cli.options import add_iterations_option, add_published_options, network_help
from stereokit.errors import ConfigError
from stereokit.export.calibration import find_pairs
from stereokit.export.onnx import OPSETS, export_onnx
from stereokit.export.openvino import PRECISIONS, export_openvino
from stereokit.export.program import export_program
from stereokit.export.report import ExportReport
from stereokit.export.target import check_target

__all__ = ["add_arguments", "run"]

SUFFIXES = {"onnx": ".onnx", "openvino": ".xml", "program": ".pt2"}

HELD_OUT = 4
"""Pairs of a calibration that are kept for the comparison, where there are few a fifth."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit export`."""
    parser.add_argument("weights", nargs="?", metavar="WEIGHTS", help=f"{network_help()} (default: those of --model)")
    parser.add_argument("--model", help="name of the network that the weights are of (default: coex)")
    add_published_options(parser)
    add_iterations_option(parser)
    parser.add_argument("--to", required=True, choices=SUFFIXES, help="ONNX, OpenVINO, or a program of torch.export")
    parser.add_argument("--out", required=True, metavar="FILE", help=f"ends in {', '.join(SUFFIXES.values())}")
    parser.add_argument(
        "--size", nargs=2, type=int, metavar=("HEIGHT", "WIDTH"), help="for this size alone (default: any)"
    )
    parser.add_argument("--opset", type=int, help=f"of ONNX, {OPSETS[0]} to {OPSETS[-1]} (default: {OPSETS[0]})")
    parser.add_argument("--precision", choices=PRECISIONS, help="of OpenVINO (default: float32)")
    parser.add_argument(
        "--calibrate",
        nargs="+",
        metavar="PAIRS",
        help="pairs for int8: left and right images, folders or quoted patterns; a data set KIND:ROOT; or synthetic",
    )
    parser.add_argument(
        "--calibration-pairs", type=int, default=32, metavar="N", help="take at most N of them (default: %(default)s)"
    )
    parser.add_argument(
        "--check",
        nargs="+",
        metavar="PAIRS",
        help=f"pairs to compare with PyTorch on, named likewise; {HELD_OUT} of them at most, spread evenly",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")


def run(options: argparse.Namespace) -> None:
    """Exports as the options say and prints how far the file is from PyTorch.

    Raises:
        StereoKitError: options, a network or pairs that can't be used; then nothing is written.
    """
    check_target(options.out, SUFFIXES[options.to], overwrite=options.overwrite)
    if options.to != "onnx" and options.opset is not None:
        raise ConfigError(f"--opset is for --to onnx; leave it out for {options.to}")
    if options.to != "openvino" and (options.precision not in (None, "float32") or options.calibrate):
        raise ConfigError(f"--precision and --calibrate are for --to openvino; leave them out for {options.to}")
    network = load_chosen_network(options)
    print(f"writing {options.out} and comparing it with PyTorch; that may take minutes", flush=True)
    print(_export(options, network))


def _export(options: argparse.Namespace, network: nn.Module) -> ExportReport:
    size = None if options.size is None else (options.size[0], options.size[1])
    pairs = find_pairs(options.check, HELD_OUT, network, size) if options.check else None
    if options.to == "onnx":
        opset = OPSETS[0] if options.opset is None else options.opset
        return export_onnx(network, options.out, size=size, opset=opset, overwrite=options.overwrite, pairs=pairs)
    if options.to == "program":
        return export_program(network, options.out, size=size, overwrite=options.overwrite, pairs=pairs)
    calibration = None
    if options.calibrate:
        found = find_pairs(options.calibrate, options.calibration_pairs + HELD_OUT, network, size)
        names = list(found)
        held_out = min(HELD_OUT, max(len(names) - options.calibration_pairs, len(names) // 5))
        if pairs is None and held_out:
            kept, names = names[-held_out:], names[:-held_out]
            pairs = {name: found[name] for name in kept}
        calibration = [found[name] for name in names[: options.calibration_pairs]]
    return export_openvino(
        network,
        options.out,
        size=size,
        precision=options.precision or "float32",
        calibration=calibration,
        overwrite=options.overwrite,
        pairs=pairs,
    )
