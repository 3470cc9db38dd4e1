"""The `stereokit` command: its parser and its table of commands."""

import argparse
import io
import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import NoReturn

from stereokit._version import __version__
from stereokit.cli import (
    bag,
    bench,
    calibrate,
    calibrate_board,
    calibrate_convert,
    check,
    convert,
    data,
    export,
    info,
    predict,
    rectify,
    synth,
    synth_rig,
    train,
    view,
)
from stereokit.cli import eval as evaluation
from stereokit.cli import list as listing
from stereokit.cli.interrupts import Terminated, end_in_order
from stereokit.errors import StereoKitError
from stereokit.optimize import keep_freed_memory

__all__ = ["main"]

COMMANDS: Mapping[str, tuple[ModuleType, str]] = {
    "predict": (predict, "turn a rectified pair, or many, into disparity maps"),
    "view": (view, "look at pairs and results in the browser: maps, cloud, distributions"),
    "check": (check, "find out whether a pair is rectified, in order, and fit to be matched"),
    "calibrate": (calibrate, "find the lenses and the pose of two cameras from views of a board"),
    "calibrate board": (calibrate_board, "print a board to calibrate with, as PDF or PNG"),
    "calibrate convert": (calibrate_convert, "write a calibration in another format, or for resized images"),
    "rectify": (rectify, "turn views of a calibrated rig into rectified pairs"),
    "bag": (bag, "turn the images of a ROS bag into one of disparity and point clouds"),
    "eval": (evaluation, "count errors on data sets with ground truth"),
    "export": (export, "write a network as ONNX, OpenVINO or torch.export file, and check it"),
    "train": (train, "train a network by a recipe"),
    "bench": (bench, "time networks, backends and sizes against each other"),
    "data": (data, "look at a data set on disk"),
    "list": (listing, "list networks and components"),
    "info": (info, "parameters and multiply-adds of a network, block by block"),
    "convert": (convert, "turn a published checkpoint into a saved network"),
    "synth": (synth, "render synthetic pairs with ground truth, in SceneFlow's layout"),
    "synth rig": (synth_rig, "render a rig: views of a board and a scene with true depth, to try calibrate on"),
}
"""By name: the module, with `add_arguments(parser)` and `run(options)`, and a line of help."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        """Bad usage is one line, as every other error."""
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line.

    Args:
        arguments: without the program's name; those of the process by default.

    Returns:
        The exit code: 0, or what the command says; 2 with one line on standard error where it fails; 128 and the
        number of the signal that ended it.

    >>> main(["list", "costs", "*correlation"])
    correlation
    groupwise_correlation
    0
    """
    if arguments is None:
        # the process is this command's own
        keep_freed_memory()
        end_in_order()
        if isinstance(sys.stdout, io.TextIOWrapper):
            # names of files may be any bytes; a name that can't be shown must not lose what was computed
            sys.stdout.reconfigure(errors="backslashreplace")
    given = _commanded(sys.argv[1:] if arguments is None else list(arguments))
    options, unknown = _parser().parse_known_args(given, argparse.Namespace(arguments=given))
    if unknown:
        _refuse(options.command, unknown)
    command, _ = COMMANDS[options.command]
    try:
        with _warnings_on_one_line():
            code: int | None = command.run(options)
    except StereoKitError as error:
        print(f"stereokit {options.command}: {error}", file=sys.stderr)
        return 2
    except Terminated as told:
        return 128 + told.number
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return code or 0


@contextmanager
def _warnings_on_one_line() -> Iterator[None]:
    """The library's warnings, without the place in its code that Python adds."""
    usual = warnings.formatwarning
    package = Path(__file__).parents[1]

    def formatted(
        message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
    ) -> str:
        if issubclass(category, UserWarning) and package in Path(filename).parents:
            # a bar may stand in the line
            return f"{chr(13) + chr(27) + '[K' if sys.stderr.isatty() else ''}warning: {message}\n"
        return usual(message, category, filename, lineno, line)

    warnings.formatwarning = formatted
    try:
        yield
    finally:
        warnings.formatwarning = usual


def _commanded(arguments: list[str]) -> list[str]:
    """The arguments, with a command of two words as one."""
    both = " ".join(arguments[:2])
    return [both, *arguments[2:]] if both in COMMANDS and len(arguments) > 1 else arguments


def _refuse(command: str, unknown: Sequence[str]) -> NoReturn:
    """What argparse says of arguments that a command does not know, which names no command."""
    unquoted = not unknown[0].startswith("-")
    hint = " (a pattern such as 'left/*.png' must stand in quotes)" if unquoted else ""
    print(
        f"stereokit {command}: unrecognized arguments: {' '.join(unknown)}{hint}; see stereokit {command} --help",
        file=sys.stderr,
    )
    raise SystemExit(2)


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="stereokit", description="Stereo matching: disparity maps from rectified pairs of images.")
    parser.add_argument("--version", action="version", version=f"stereokit {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, (command, help_line) in COMMANDS.items():
        command.add_arguments(commands.add_parser(name, help=help_line))
    return parser
