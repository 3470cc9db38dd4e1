import pickle
from dataclasses import fields

import numpy as np
import pytest
from torch.utils.data import DataLoader

from stereokit.data.synthetic import Composition, SyntheticScenes
from stereokit.errors import ConfigError

SETTINGS = {"seed": 3, "size": (48, 64), "max_disparity": 20}
PARTS = ("left", "right", "disparity", "right_disparity", "nonocc", "right_nonocc")


@pytest.fixture(scope="module")
def small():
    return SyntheticScenes(**SETTINGS, count=6)


def first(batch):
    return batch[0]


def assert_same(one, other):
    assert one.name == other.name
    for part in PARTS:
        np.testing.assert_array_equal(getattr(one, part), getattr(other, part))


def test_samples(small):
    assert len(small) == 6
    for sample in small:
        assert sample.left.shape == sample.right.shape == (48, 64, 3)
        assert sample.left.dtype == np.uint8
        assert sample.disparity.dtype == sample.right_disparity.dtype == np.float32
        assert sample.nonocc.dtype == sample.right_nonocc.dtype == bool
        assert 0 <= sample.disparity.min() <= sample.disparity.max() <= 20
    assert len({sample.left.tobytes() for sample in small}) == 6
    assert_same(small[-1], small[5])
    with pytest.raises(IndexError):
        small[6]


def test_no_disparity_is_0_which_stands_for_unknown():
    scenes = SyntheticScenes(size=(32, 32), max_disparity=20, objects=(0, 1), count=60)
    assert min(sample.disparity.min() for sample in scenes) > 0
    assert min(sample.right_disparity.min() for sample in scenes) > 0


@pytest.mark.parametrize("workers", [0, 2])
def test_the_number_of_workers_changes_nothing(small, workers):
    context = "fork" if workers else None
    loader = DataLoader(small, collate_fn=first, num_workers=workers, multiprocessing_context=context)
    for index, sample in enumerate(loader):
        assert_same(sample, small[index])


def test_every_setting_of_a_composition_is_passed_on():
    settings = {"thin": 0.1, "alike": 0.2, "shaded": 0.3, "glossy": 0.4, "objects": (1, 2), "range_exponent": 0.5}
    settings |= {"size": (48, 96), "max_disparity": 32.0, "disparity_exponent": 1.6}
    assert SyntheticScenes(**settings).composition == Composition(**settings)
    assert settings.keys() == {field.name for field in fields(Composition)}


def test_an_item_hangs_on_seed_and_index_alone(small):
    again = SyntheticScenes(**SETTINGS)
    assert_same(again[4], small[4])
    assert_same(pickle.loads(pickle.dumps(small))[2], small[2])
    other = SyntheticScenes(**{**SETTINGS, "seed": 0})
    assert (other[4].left != small[4].left).mean() > 0.5


@pytest.mark.parametrize("options", [{"seed": -1}, {"count": 0}, {"photometric": 3.0}, {"size": (8, 8)}])
def test_wrong_settings(options):
    with pytest.raises(ConfigError):
        SyntheticScenes(**{**SETTINGS, **options})
