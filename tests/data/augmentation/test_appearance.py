import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereokit.data.augmentation import adjust_colour, colour_jitter, occlude_right_view, random_occlusion
from stereokit.data.datasets import StereoSample
from stereokit.errors import InputError
from tests.data.augmentation.pairs import errors, layered

SEEDS = st.integers(0, 2**32 - 1)


def same_geometry(result, pair):
    return all(getattr(result, part) is getattr(pair, part) for part in ("disparity", "objects", "calibration"))


@given(seed=SEEDS, floating=st.booleans())
@settings(deadline=None)
def test_alike_keeps_the_views_alike(seed, floating):
    pair = layered(seed, floating=floating)
    result = colour_jitter(pair, np.random.default_rng(seed))
    assert errors(result).max() == 0
    assert (result.left != pair.left).any()
    assert result.left.dtype == result.right.dtype == pair.left.dtype
    assert same_geometry(result, pair)
    if floating:
        assert 0 <= result.left.min() <= result.left.max() <= 1


@given(seed=SEEDS)
@settings(deadline=None)
def test_apart_changes_each_view_but_moves_no_pixel(seed):
    pair = layered(seed)
    result = colour_jitter(pair, np.random.default_rng(seed), apart=True)
    assert same_geometry(result, pair)
    assert (result.left != pair.left).any()
    assert (result.right != pair.right).any()
    # Pixels that match had one colour, and in each view the new colour is a function of the old one.
    rows, columns = np.nonzero(pair.nonocc)
    match = columns - pair.disparity[rows, columns].astype(int)
    new = {}
    for row, column, other in zip(rows, columns, match, strict=True):
        both = (*result.left[row, column], *result.right[row, other])
        assert new.setdefault(tuple(pair.left[row, column]), both) == both


def test_apart_draws_twice():
    image = layered().left
    result = colour_jitter(StereoSample("a", image, image), np.random.default_rng(0), apart=True)
    assert (result.left != result.right).any()


def test_what_each_factor_does():
    image = np.array([[[200, 100, 0], [50, 50, 50]]], np.uint8)
    np.testing.assert_array_equal(adjust_colour(image), image)
    np.testing.assert_array_equal(adjust_colour(image, brightness=0.5), [[[100, 50, 0], [25, 25, 25]]])
    assert len(set(adjust_colour(image, saturation=0)[0, 0].tolist())) == 1
    assert np.ptp(adjust_colour(image, saturation=0, contrast=0)) == 0
    np.testing.assert_allclose(adjust_colour(image, gamma=2), np.rint(image.astype(float) ** 2 / 255), atol=1)
    assert adjust_colour(image, brightness=10).max() == 255
    assert adjust_colour(image, contrast=10).min() == 0


@pytest.mark.parametrize("wrong", [{"brightness": -1}, {"contrast": -0.1}, {"saturation": -1}, {"gamma": 0}])
def test_impossible_factors(wrong):
    with pytest.raises(InputError, match="expected factors of at least 0"):
        adjust_colour(layered().left, **wrong)
    with pytest.raises(InputError, match="from 0 to below 1"):
        colour_jitter(layered(), np.random.default_rng(), **{next(iter(wrong)): 1.0})


@given(
    seed=SEEDS,
    top=st.integers(-20, 40),
    left=st.integers(-20, 60),
    height=st.integers(1, 30),
    width=st.integers(1, 30),
    floating=st.booleans(),
)
@settings(deadline=None)
def test_occlusion_hides_a_rectangle_and_no_more(seed, top, left, height, width, floating):
    pair = layered(seed, floating=floating)
    result = occlude_right_view(pair, top=top, left=left, height=height, width=width)
    inside = np.zeros((32, 48), bool)
    inside[max(top, 0) : max(top + height, 0), max(left, 0) : max(left + width, 0)] = True
    np.testing.assert_array_equal(result.right[~inside], pair.right[~inside])
    if inside.any():
        assert np.ptp(result.right[inside].reshape(-1, 3), axis=0).max() == 0
        mean = pair.right.reshape(-1, 3).mean(axis=0)
        np.testing.assert_allclose(result.right[inside][0], mean, atol=0.51 if not floating else 1e-5)
    match = np.arange(48) - pair.disparity.astype(int)
    hidden = np.take_along_axis(inside, np.maximum(match, 0), 1) & (match >= 0)
    np.testing.assert_array_equal(result.nonocc, pair.nonocc & ~hidden)
    if result.nonocc.any():
        assert errors(result).max() == 0
    assert result.left is pair.left
    assert same_geometry(result, pair)


def test_the_pair_given_is_left_alone():
    pair = layered()
    before = pair.right.copy(), pair.nonocc.copy()
    occlude_right_view(pair, top=0, left=0, height=32, width=48)
    np.testing.assert_array_equal(pair.right, before[0])
    np.testing.assert_array_equal(pair.nonocc, before[1])


def test_random_occlusion_has_its_size():
    pair = layered(height=64, width=96)
    sides = set()
    for seed in range(200):
        result = random_occlusion(pair, np.random.default_rng(seed), smallest=5, largest=7)
        changed = (result.right != pair.right).any(axis=2)
        rows, columns = np.nonzero(changed.any(axis=1))[0], np.nonzero(changed.any(axis=0))[0]
        sides |= {np.ptp(rows) + 1, np.ptp(columns) + 1}
    assert max(sides) == 7
    for smallest, largest in ((0, 1), (3, 2)):
        with pytest.raises(InputError, match="0 < smallest <= largest"):
            random_occlusion(pair, np.random.default_rng(), smallest=smallest, largest=largest)


def test_what_is_hidden_has_no_truth_of_its_own():
    pair = layered(both=True)
    result = occlude_right_view(pair, top=4, left=-3, height=10, width=20)
    inside = np.zeros(pair.right_disparity.shape, bool)
    inside[4:14, :17] = True
    np.testing.assert_array_equal(result.right_disparity, np.where(inside, np.nan, pair.right_disparity))
    np.testing.assert_array_equal(result.right_nonocc, pair.right_nonocc & ~inside)
    assert np.isfinite(pair.right_disparity).all()
