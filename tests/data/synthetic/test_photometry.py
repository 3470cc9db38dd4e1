import numpy as np
import pytest

from stereokit.data.datasets import StereoSample
from stereokit.data.synthetic import Cameras


def taken(scenes, seeds, strength=1.0):
    cameras, pair = Cameras(0, strength), scenes[4]
    return [cameras(pair, np.random.default_rng(seed)) for seed in seeds]


def test_no_strength_no_change(scenes):
    pair = scenes[4]
    assert Cameras(0, 0.0)(pair, np.random.default_rng(0)) is pair


def test_the_left_geometry_stays(scenes):
    before = scenes[4]
    for pair in taken(scenes, range(20)):
        assert pair.left.dtype == pair.right.dtype == np.uint8
        np.testing.assert_array_equal(pair.disparity, before.disparity)
        np.testing.assert_array_equal(pair.nonocc, before.nonocc)
        assert pair.left.shape == before.left.shape


def test_cameras_differ_from_each_other_and_from_time_to_time(scenes):
    pairs = taken(scenes, range(60))
    apart = np.array([pair.left.mean() - pair.right.mean() for pair in pairs])
    assert np.ptp(apart) > 10
    assert np.ptp([pair.left.mean() for pair in pairs]) > 40
    grey = [(pair.left[..., 0] == pair.left[..., 1]).all() and np.ptp(pair.right, axis=2).max() == 0 for pair in pairs]
    assert 1 < sum(grey) < 25
    weak = taken(scenes, range(60), 0.2)
    assert np.ptp([pair.left.mean() - pair.right.mean() for pair in weak]) < 0.7 * np.ptp(apart)


def test_it_hangs_on_the_generator_alone(scenes):
    (first,), (again,) = taken(scenes, [7]), taken(scenes, [7])
    np.testing.assert_array_equal(first.left, again.left)
    np.testing.assert_array_equal(first.right, again.right)


@pytest.mark.parametrize("size", [(1, 1), (900, 800)])
def test_any_size(scenes, size):
    image = np.full((*size, 3), 128, np.uint8)
    pair = Cameras(0)(StereoSample("a", image, image), np.random.default_rng(0))
    assert pair.left.shape == image.shape


def test_next_to_no_strength_is_next_to_no_change(scenes):
    before = scenes[4]
    for pair in taken(scenes, range(12), 1e-6):
        grey = np.ptp(pair.left, axis=2).max() == 0
        reference = before.left.astype(float) @ [0.299, 0.587, 0.114] if grey else before.left.mean(axis=2)
        assert pair.left.mean() == pytest.approx(reference.mean(), abs=1)
        assert pair.left.mean() - pair.right.mean() == pytest.approx(before.left.mean() - before.right.mean(), abs=2)
