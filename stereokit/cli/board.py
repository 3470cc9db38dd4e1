"""Options that name a board, and lengths with their units."""

import argparse
import re

from stereokit.cameras.boards import Board, CharucoBoard, Checkerboard
from stereokit.errors import ConfigError

__all__ = ["UNITS", "add_board_options", "board_words", "chosen_board", "metres"]

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}
"""Of lengths, in metres."""


def metres(text: str) -> float:
    """A length with its unit, in metres.

    Raises:
        argparse.ArgumentTypeError: no number, or no unit.

    >>> metres("25mm"), metres("1in")
    (0.025, 0.0254)
    """
    parts = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)\s*", text.lower())
    if parts is not None and not parts[2]:
        raise argparse.ArgumentTypeError(f"{text!r} has no unit; say {text}mm, {text}cm, {text}m or {text}in")
    if parts is None or parts[2] not in UNITS:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is no length; expected one such as 25mm, 2.5cm, 0.025m or 1in")
    return float(f"{float(parts[1]) * UNITS[parts[2]]:.12g}")


def add_board_options(parser: argparse.ArgumentParser) -> None:
    """What board it is."""
    group = parser.add_argument_group("board")
    kind = group.add_mutually_exclusive_group(required=True)
    kind.add_argument("--checkerboard", type=_shape, metavar="CxR", help="inner corners across and down, such as 9x6")
    kind.add_argument("--charuco", type=_shape, metavar="CxR", help="squares across and down, such as 10x7")
    group.add_argument(
        "--square", type=metres, required=True, metavar="LENGTH", help="side of a square with its unit, such as 25mm"
    )
    group.add_argument("--marker", type=metres, metavar="LENGTH", help="side of a marker of --charuco, such as 18mm")
    group.add_argument("--dictionary", help="of the markers, as OpenCV names it (default: DICT_5X5_100)")
    group.add_argument(
        "--legacy", action="store_true", default=None, help="the layout of ChArUco boards before OpenCV 4.6"
    )


def chosen_board(options: argparse.Namespace) -> Board:
    """The board that the options name.

    Raises:
        ConfigError: options that are missing or have no effect.
        InputError: an impossible board.
    """
    of_charuco = {name: getattr(options, name) for name in ("marker", "dictionary", "legacy")}
    given = {name: value for name, value in of_charuco.items() if value is not None}
    if options.checkerboard is not None:
        if given:
            raise ConfigError(f"--{next(iter(given))} has no effect on a checkerboard; leave it out, or say --charuco")
        columns, rows = options.checkerboard
        return Checkerboard(columns, rows, options.square)
    if options.marker is None:
        raise ConfigError("--charuco needs the side of its markers: give --marker, such as 18mm")
    columns, rows = options.charuco
    return CharucoBoard(columns, rows, options.square, **given)


def board_words(board: Board) -> str:
    """The options that name a board.

    >>> board_words(Checkerboard(9, 6, 0.025))
    '--checkerboard 9x6 --square 25mm'
    """
    shape, square = f"{board.columns}x{board.rows}", f"--square {board.square * 1e3:g}mm"
    if isinstance(board, Checkerboard):
        return f"--checkerboard {shape} {square}"
    more = "" if board.dictionary == "DICT_5X5_100" else f" --dictionary {board.dictionary}"
    return f"--charuco {shape} {square} --marker {board.marker * 1e3:g}mm{more}{' --legacy' if board.legacy else ''}"


def _shape(text: str) -> tuple[int, int]:
    parts = re.fullmatch(r"(\d{1,3})x(\d{1,3})", text.lower())
    if parts is None:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is no shape; expected columns x rows, such as 9x6")
    return int(parts[1]), int(parts[2])
