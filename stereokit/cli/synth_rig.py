"""`stereokit synth rig`."""

import argparse
from pathlib import Path
from typing import get_args

import numpy as np
from tqdm import tqdm

from stereokit.cameras.boards import Checkerboard
from stereokit.cameras.depth import write_depth
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rendering import (
    RigRenderer,
    board_plane,
    board_poses,
    example_rig,
    example_scene,
    rectified_depth,
)
from stereokit.cameras.rig import Model
from stereokit.cli.board import add_board_options, board_words, chosen_board
from stereokit.data.images import write_samples
from stereokit.errors import ConfigError
from stereokit.files import check_folder, check_free, make_folder

__all__ = ["add_arguments", "run"]

_LEAST_SQUARE = 11  # px, of which corners are found well


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit synth rig`."""
    add_board_options(parser)
    parser.add_argument("--out", required=True, help="folder for it")
    parser.add_argument("--views", type=int, default=30, help="of the board (default: %(default)s)")
    parser.add_argument("--model", choices=get_args(Model), default="pinhole", help="of the lenses (default: pinhole)")
    parser.add_argument("--size", nargs=2, type=int, metavar=("HEIGHT", "WIDTH"), default=[480, 640])
    parser.add_argument("--seed", type=int, default=0, help="of poses, noise and textures (default: %(default)s)")
    parser.add_argument("--overwrite", action="store_true", help="replace existing files")


def run(options: argparse.Namespace) -> None:
    """Renders views of a board, and a scene with its true depth.

    Raises:
        StereoKitError: options out of range, or files that can't be written.
    """
    board = chosen_board(options)
    size = tuple(options.size)
    if options.views < 1 or min(size) < 96 or max(size) > 4096:
        raise ConfigError(
            f"expected 1 view or more, of 96 to 4096 pixels a side, got {options.views} of {options.size}"
        )
    out, scene = Path(options.out), Path(options.out) / "scene"
    names = [f"{i:03d}.png" for i in range(options.views)]
    files = [out / side / name for name in names for side in ("left", "right")]
    files += [out / "truth.json", *(scene / name for name in ("left.png", "right.png", "depth.npy"))]
    check_folder(out)
    check_free(files, overwrite=options.overwrite)
    rig = example_rig(options.model, size=size)
    renderer = RigRenderer(rig)
    for folder in (out / "left", out / "right", scene):
        make_folder(folder)
    # near enough that squares are large, and far enough that the board is seen whole
    wide = board.columns + (1 if isinstance(board, Checkerboard) else 0)
    near = wide * board.square * rig.left.fx / (0.75 * rig.left.width)
    far = max(1.5 * near, board.square * rig.left.fx / _LEAST_SQUARE)
    poses = board_poses(options.views, seed=options.seed, near=near, far=min(far, 3 * near))
    for i, pose in enumerate(tqdm(poses, total=options.views, unit="pair", disable=None)):
        views = renderer([board_plane(board, *pose)], seed=options.seed + i)
        for side, view in zip(("left", "right"), views, strict=True):
            write_samples(out / side / names[i], view, overwrite=options.overwrite)
    planes = example_scene(options.seed)
    for side, view in zip(("left", "right"), renderer(planes, seed=options.seed), strict=True):
        write_samples(scene / f"{side}.png", view, overwrite=options.overwrite)
    depth = rectified_depth(rectify(rig), planes).astype(np.float32)
    write_depth(scene / "depth.npy", depth, overwrite=options.overwrite)
    rig.write(out / "truth.json", overwrite=options.overwrite)
    print(
        f"wrote {out}: views of the board in left and right, a pair with the true depth of its rectified left view in "
        "scene, and the true rig, truth.json"
    )
    model = "" if options.model == "pinhole" else f" --model {options.model}"
    print(f"then: stereokit calibrate {out / 'left'} {out / 'right'} {board_words(board)}{model}")
