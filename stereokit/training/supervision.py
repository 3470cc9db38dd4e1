"""Whether there is anything to learn from ground truth, before hours are spent on it."""

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from stereokit.data.datasets.dataset import StereoDataset
from stereokit.errors import InputError
from stereokit.metrics import PixelCounts, count_pixels
from stereokit.tables import counted

__all__ = ["check_supervision"]

MOST_PAIRS = 32
MOST_DROPPED = 0.5

# what PixelCounts calls it, what is said of it, and what to do about it
_RULES = (
    ("negative", "negative", "disparity is x_left - x_right, which is positive: turn the sign in the files around"),
    (
        "too_large",
        "at or above max_disparity",
        "give a larger max_disparity in [loss] of the recipe, or leave it out; or look whether the files are in pixels",
    ),
    ("zero", "0, which means unknown", "see what is in the files by stereokit data check"),
    ("not_finite", "not finite, which means unknown", "see what is in the files by stereokit data check"),
)


def check_supervision(
    name: str, pairs: Sequence[Any], *, max_disparity: float | None = None, most_pairs: int = MOST_PAIRS
) -> None:
    """Looks at the ground truth of pairs to train on: all of them, or so many of them from the first to the last.

    Args:
        name: of the pairs, for messages.
        pairs: with ground truth each; of a `StereoDataset` the images are not read.
        max_disparity: ground truth from there up does not count, in pixels; None counts all.
        most_pairs: to look at.

    Raises:
        InputError: no pixel counts, see `valid_pixels`; the message says which rules left them out. Or a file can't be
            read.

    Warns:
        UserWarning: more than half of the pixels that have a value do not count.

    >>> from stereokit.data.datasets import StereoSample
    >>> image = np.zeros((2, 4, 3), np.uint8)
    >>> check_supervision("mine", [StereoSample("a", image, image, np.full((2, 4), -3, np.float32))])
    Traceback (most recent call last):
    stereokit.errors.InputError: mine: no pixel of the ground truth counts, in 1 pair looked at: 100 % are negative; \
disparity is x_left - x_right, which is positive: turn the sign in the files around
    """
    looked_at = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), most_pairs)).round().astype(int))
    counts = sum((_count(pairs, int(index), max_disparity) for index in looked_at), PixelCounts())
    seen = f"in {counted(len(looked_at), 'pair')} looked at"
    if not counts.valid:
        raise InputError(f"{name}: no pixel of the ground truth counts, {seen}: {_reasons(counts, counts.total)}")
    dropped = PixelCounts(negative=counts.negative, too_large=counts.too_large)
    if dropped.total > MOST_DROPPED * counts.known:
        share = 100 * counts.valid / counts.known
        warnings.warn(
            f"{name}: only {share:.3g} % of the pixels with a disparity are trained on, {seen}: "
            f"{_reasons(dropped, counts.known)}",
            stacklevel=4,
        )


def _count(pairs: Sequence[Any], index: int, max_disparity: float | None) -> PixelCounts:
    if isinstance(pairs, StereoDataset) and (source := pairs.entries[index].disparity) is not None:
        truth = source()
    else:
        truth = pairs[index].disparity
    return count_pixels(truth, max_disparity=max_disparity)


def _reasons(dropped: PixelCounts, total: int) -> str:
    """Which rules leave pixels out, the commonest first, and what to do about that one."""
    rules = sorted((rule for rule in _RULES if getattr(dropped, rule[0])), key=lambda rule: -getattr(dropped, rule[0]))
    shares = [f"{100 * getattr(dropped, rule) / total:.3g} % are {words}" for rule, words, _ in rules]
    return f"{', '.join(shares)}; {rules[0][2]}"
