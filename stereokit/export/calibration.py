"""Pairs of images for calibration and comparison, from where the command line names them."""

from collections.abc import Sequence

from torch import nn

from stereokit.data.datasets.opening import open_dataset
from stereokit.data.inputs import to_pair
from stereokit.data.pairs import match_pairs
from stereokit.data.synthetic import SyntheticScenes
from stereokit.errors import InputError
from stereokit.export.checking import Pair

__all__ = ["SYNTHETIC", "find_pairs"]

SYNTHETIC = "synthetic"
SYNTHETIC_SIZE = (256, 512)


def find_pairs(source: Sequence[str], count: int, model: nn.Module, size: tuple[int, int] | None) -> dict[str, Pair]:
    """At most `count` pairs by name, spread evenly over what there is.

    Args:
        source: "synthetic" for rendered scenes, one data set as `open_dataset` takes it, or the left and the right
            images as `match_pairs` takes them.
        count: how many.
        model: rendered scenes keep to its disparities.
        size: of rendered scenes.

    Raises:
        InputError: nothing is found, or it can't be read.

    >>> pairs = find_pairs(["synthetic"], 1, nn.Identity(), (64, 96))
    >>> [(name, left.shape) for name, (left, _) in pairs.items()]
    [('rendered scene 0', torch.Size([1, 3, 64, 96]))]
    """
    if count < 1:
        raise InputError(f"at least 1 pair is needed; got {count}")
    if list(source) == [SYNTHETIC]:
        height, width = size or SYNTHETIC_SIZE
        highest = min(getattr(model, "max_disparity", width), width) / 4 + width / 16
        scenes = SyntheticScenes(size=(height, width), max_disparity=highest, count=count)
        return {f"rendered scene {i}": to_pair(scenes[i].left, scenes[i].right) for i in range(count)}
    if len(source) == 1:
        dataset = open_dataset(source[0])
        samples = (dataset[i] for i in _spread(len(dataset), count))
        return {sample.name: to_pair(sample.left, sample.right) for sample in samples}
    if len(source) == 2:
        files = match_pairs(*source)
        return {files[i].name: to_pair(files[i].left, files[i].right) for i in _spread(len(files), count)}
    raise InputError(
        f"pairs are named by {SYNTHETIC!r}, one data set KIND:ROOT, or left and right images; got {len(source)} names"
    )


def _spread(length: int, count: int) -> list[int]:
    return sorted({i * length // count for i in range(count)}) if length else []
