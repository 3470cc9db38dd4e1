import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereokit.data.augmentation import Augmentation
from stereokit.errors import InputError
from tests.data.augmentation.pairs import errors, layered, slanted

SEEDS = st.integers(0, 2**32 - 1)
EVERYTHING = Augmentation(
    crop_height=24,
    crop_width=40,
    scale_range=(0.7, 1.4),
    flip=0.5,
    colour=0.8,
    vertical_jitter=1.0,
    occlusion=0.5,
)


@given(seed=SEEDS)
@settings(deadline=None)
def test_any_pair_comes_out_whole(seed):
    result = EVERYTHING(layered(seed), np.random.default_rng(seed))
    assert result.left.shape == result.right.shape == (24, 40, 3)
    assert result.left.dtype == result.right.dtype == np.uint8
    assert result.disparity.shape == result.nonocc.shape == result.objects.shape == (24, 40)
    assert (result.calibration.width, result.calibration.height) == (40, 24)
    for view in (result.left, result.right):
        assert view.flags.c_contiguous


@given(seed=SEEDS)
@settings(deadline=None)
def test_moving_pixels_keeps_the_truth(seed):
    moves = Augmentation(crop_height=24, crop_width=36, scale_range=(0.8, 1.4), flip=0.5)
    result = moves(slanted(offset=5.0, slope=0.03), np.random.default_rng(seed))
    assert np.quantile(errors(result), 0.95) < 0.12
    assert errors(result, result.disparity + np.float32(1)).mean() > 2 * errors(result).mean()


def test_it_hangs_on_the_generator_alone():
    pair = layered()
    one, two = (EVERYTHING(pair, np.random.default_rng([1, 2, 3])) for _ in range(2))
    other = EVERYTHING(pair, np.random.default_rng([1, 2, 4]))
    np.testing.assert_array_equal(one.left, two.left)
    np.testing.assert_array_equal(one.right, two.right)
    np.testing.assert_array_equal(one.disparity, two.disparity)
    assert (one.left != other.left).any()


def test_by_default_it_only_crops():
    pair = layered()
    result = Augmentation(crop_height=32, crop_width=48)(pair, np.random.default_rng(0))
    for part in ("left", "right", "disparity", "nonocc", "objects"):
        np.testing.assert_array_equal(getattr(result, part), getattr(pair, part))


def test_a_small_pair_is_enlarged():
    result = Augmentation(crop_height=64, crop_width=50)(layered(), np.random.default_rng(0))
    assert result.left.shape == (64, 50, 3)


@pytest.mark.parametrize("name", ["flip", "colour", "occlusion"])
def test_how_often(name):
    augment = Augmentation(crop_height=32, crop_width=48, **{name: 0.25})
    pair = layered()
    results = [augment(pair, np.random.default_rng(seed)) for seed in range(400)]
    changed = sum(bool((result.right != pair.right).any()) for result in results)
    assert 70 < changed < 130


def test_bad_settings():
    with pytest.raises(InputError, match="can't crop to 0 x 4"):
        Augmentation(crop_height=4, crop_width=0)
    with pytest.raises(InputError, match="flip is a probability from 0 to 1, got 2"):
        Augmentation(crop_height=4, crop_width=4, flip=2)
