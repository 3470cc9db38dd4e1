import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereokit.data import write_disparity, write_image
from stereokit.data.datasets import StereoSample, open_dataset
from stereokit.errors import InputError
from stereokit.training.supervision import check_supervision


def pairs(*truths):
    image = np.zeros((1, 8, 3), np.uint8)
    return [StereoSample(str(i), image, image, np.float32([truth])) for i, truth in enumerate(truths)]


@pytest.mark.parametrize(
    ("truth", "words"),
    [
        ([-3] * 8, "100 % are negative; disparity is x_left - x_right"),
        ([0] * 8, "100 % are 0, which means unknown; see what is in the files"),
        ([np.nan] * 8, "100 % are not finite"),
        ([200] * 8, r"100 % are at or above max_disparity; give a larger max_disparity in \[loss\]"),
        ([0, 0, -1, -1, -1, 500, np.nan, -1], "50 % are negative, 25 % are 0, .*12.5 % are at .*; disparity is x_left"),
    ],
)
def test_nothing_to_learn_from_is_an_error_that_names_the_rule(truth, words):
    with pytest.raises(InputError, match=f"mine: no pixel of the ground truth counts, in 2 pairs looked at: {words}"):
        check_supervision("mine", pairs(truth, truth), max_disparity=192)


@given(st.lists(st.lists(st.sampled_from([-4, 0, 4, 300, np.nan]), min_size=8, max_size=8), min_size=1, max_size=6))
def test_a_warning_tells_that_more_than_half_is_dropped(truths):
    values = np.float32(truths)
    valid, dropped = (values == 4).sum(), ((values < 0) | (values == 300)).sum()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if not valid:
            with pytest.raises(InputError, match="no pixel"):
                check_supervision("mine", pairs(*truths), max_disparity=192)
            return
        check_supervision("mine", pairs(*truths), max_disparity=192)
    assert bool(caught) == (dropped > valid)
    if caught:
        assert f"only {100 * valid / (valid + dropped):.3g} % of the pixels with a disparity" in str(caught[0].message)


class Counting:
    """Pairs of which one has something to learn from; it keeps which were looked at."""

    def __init__(self, number, good):
        self.number, self.good, self.seen = number, good, []

    def __len__(self):
        return self.number

    def __getitem__(self, index):
        self.seen.append(index)
        return pairs([1 if index == self.good else 0] * 8)[0]


def test_the_work_is_bounded_and_reaches_from_the_first_to_the_last():
    many = Counting(10_000, good=9_999)
    check_supervision("mine", many)
    assert len(many.seen) == len(set(many.seen)) == 32
    assert (many.seen[0], many.seen[-1]) == (0, 9_999)
    few = Counting(5, good=3)
    check_supervision("mine", few)
    assert few.seen == [0, 1, 2, 3, 4]


def test_images_are_not_read(tmp_path):
    for view in ("left", "right"):
        write_image(tmp_path / f"{view}.png", np.zeros((4, 6, 3), np.uint8))
    write_disparity(tmp_path / "disparity.pfm", np.ones((4, 6)))
    dataset = open_dataset(f"folder:{tmp_path}")
    (tmp_path / "left.png").unlink()
    check_supervision("mine", dataset)
