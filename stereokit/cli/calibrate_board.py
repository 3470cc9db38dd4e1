"""`stereokit calibrate board`."""

import argparse

from stereokit.cameras.printing import PAPERS, BoardSheet
from stereokit.cli.board import add_board_options, board_words, chosen_board

__all__ = ["add_arguments", "run"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit calibrate board`."""
    add_board_options(parser)
    parser.add_argument("--out", default="board.pdf", help="ends in .pdf or .png (default: %(default)s)")
    parser.add_argument(
        "--paper", help=f"{', '.join(PAPERS)}, or a size such as 600x400mm (default: the smallest that fits)"
    )
    parser.add_argument("--dpi", type=int, default=300, help="of a PNG (default: %(default)s)")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")


def run(options: argparse.Namespace) -> None:
    """Writes the board, and says how to go on.

    Raises:
        StereoKitError: an impossible board, one that does not fit the paper, or a file that can't be written.
    """
    board = chosen_board(options)
    sheet = BoardSheet(board, options.paper)
    sheet.write(options.out, dpi=options.dpi, overwrite=options.overwrite)
    width, height = (side * 1e3 for side in sheet.size)
    print(f"wrote {options.out}, {width:.0f} x {height:.0f} mm; print it at 100 %, check the ruler, glue it on a plate")
    print(f"then: stereokit calibrate LEFT RIGHT {board_words(board)}")
