"""`stereokit synth`."""

import argparse
import os
from collections.abc import Callable, Iterable
from pathlib import Path

from tqdm import tqdm

from stereokit.data.disparity_arrays import PathLike
from stereokit.data.images import write_image
from stereokit.data.pfm import write_pfm
from stereokit.data.synthetic.dataset import SyntheticScenes
from stereokit.errors import InputError
from stereokit.files import make_folder
from stereokit.tables import counted
from stereokit.training.recipe import load_recipe

__all__ = ["add_arguments", "run", "write_scenes"]

_PAIRS_A_SEQUENCE = 100


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `stereokit synth`."""
    parser.add_argument("--count", type=int, required=True, help="number of pairs")
    parser.add_argument("--out", required=True, help="folder for them")
    parser.add_argument("--seed", type=int, default=0, help="of all that is random (default: %(default)s)")
    parser.add_argument("--recipe", help="scenes as this one of stereokit train renders them, such as synthetic")
    parser.add_argument(
        "--size", nargs=2, type=int, metavar=("HEIGHT", "WIDTH"), help="(default: 256 512, or the recipe's)"
    )
    parser.add_argument("--max-disparity", type=float, help="in pixels (default: 96, or the recipe's)")
    parser.add_argument("--textures", metavar="DIR", help="folder of photographs to use besides procedural textures")
    parser.add_argument("--split", choices=("test", "train"), default="test", help="(default: %(default)s)")


def write_scenes(
    scenes: SyntheticScenes,
    out: PathLike,
    *,
    split: str = "test",
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> None:
    """Writes scenes in SceneFlow's layout, with the ground truth of both views, as `open_dataset` reads it.

    Pair 123 of the split "test" is frames_finalpass/TEST/A/0001/left/0023.png, the same with right, and
    disparity/TEST/A/0001/left/0023.pfm, the same with right.

    Args:
        scenes: all of which are written.
        out: the folder, which is made where it is not there.
        split: "test" or "train". A folder can hold both.
        progress: what to pass the numbers of the scenes through on the way, such as `tqdm.tqdm`.

    Raises:
        InputError: another split, one that the folder holds already, or a file that can't be written.

    >>> import tempfile
    >>> from stereokit.data import open_dataset
    >>> folder = tempfile.mkdtemp()
    >>> write_scenes(SyntheticScenes(size=(32, 48), max_disparity=16, count=2), folder)
    >>> open_dataset(f"sceneflow:{folder}")[1].right_disparity.shape
    (32, 48)
    """
    if split not in ("test", "train"):
        raise InputError(f"unknown split {split!r}; expected one of test, train")
    images, disparities = (Path(out) / tree / split.upper() for tree in ("frames_finalpass", "disparity"))
    for folder in (images, disparities):
        if folder.exists():
            raise InputError(f"{os.fspath(folder)!r} exists already; choose another folder, or the other split")
    for index in progress(range(len(scenes))):
        sequence, frame = divmod(index, _PAIRS_A_SEQUENCE)
        sample = scenes[index]
        views = (("left", sample.left, sample.disparity), ("right", sample.right, sample.right_disparity))
        for view, image, disparity in views:
            assert disparity is not None
            place = Path("A", f"{sequence:04d}", view, f"{frame:04d}")
            for path in (images / place, disparities / place):
                make_folder(path.parent)
            write_pfm((disparities / place).with_suffix(".pfm"), disparity)
            write_image((images / place).with_suffix(".png"), image)


def run(options: argparse.Namespace) -> None:
    """Renders the scenes and says how the data set is read.

    Raises:
        StereoKitError: options that can't be used, or files that can't be written.
    """
    chosen = {"size": options.size and tuple(options.size), "max_disparity": options.max_disparity}
    settings = {name: value for name, value in chosen.items() if value is not None}
    render = SyntheticScenes if options.recipe is None else load_recipe(options.recipe).rendered_scenes
    scenes = render(seed=options.seed, textures=options.textures, count=options.count, **settings)
    write_scenes(scenes, options.out, split=options.split, progress=lambda numbers: tqdm(numbers, unit="pair"))
    kind = "sceneflow" if options.split == "test" else "sceneflow/train"
    print(f"wrote {counted(len(scenes), 'pair')}; to be read as {kind}:{options.out}")
