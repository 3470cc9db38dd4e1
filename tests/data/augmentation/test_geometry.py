from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from stereokit.data.augmentation import (
    crop,
    flip_and_swap,
    random_crop,
    random_scale,
    scale,
    shift_right_view,
    vertical_jitter,
)
from stereokit.data.datasets import StereoSample
from stereokit.data.datasets.sceneflow import sceneflow
from stereokit.errors import InputError
from tests.data.augmentation.pairs import errors, layered, right_errors, slanted
from tests.shared import SHARED, needs_shared

SEEDS = st.integers(0, 2**32 - 1)


def sparse(sample, seed):
    known = np.random.default_rng(seed).random(sample.disparity.shape) < 0.3
    return replace(sample, disparity=np.where(known, sample.disparity, np.nan).astype(np.float32))


def test_the_measure_can_fail():
    for pair in (layered(), slanted()):
        assert errors(pair).max() < 0.05
        assert errors(pair, pair.disparity + 1).mean() > 0.05


@given(seed=SEEDS)
@settings(deadline=None)
def test_crop_keeps_the_truth(seed):
    rng = np.random.default_rng(seed)
    height, width = rng.integers(8, 33), rng.integers(20, 49)
    pair = layered(seed)
    result = random_crop(pair, rng, height=height, width=width)
    assert result.left.shape == result.right.shape == (height, width, 3)
    assert result.disparity.shape == result.objects.shape == (height, width)
    assert (result.calibration.width, result.calibration.height) == (width, height)
    assert errors(result).max() == 0
    # A match outside of the window is hidden, whatever the whole view showed.
    assert not result.nonocc[np.arange(width) - result.disparity < 0].any()


def test_crop_is_the_same_window_everywhere():
    pair = layered()
    result = crop(pair, top=3, left=5, height=10, width=20)
    for part in ("left", "right", "disparity", "objects"):
        np.testing.assert_array_equal(getattr(result, part), getattr(pair, part)[3:13, 5:25])
    assert result.calibration.depth(4.0) == pair.calibration.depth(4.0)
    assert result.calibration.cx0 == pair.calibration.cx0 - 5


def test_crop_leaves_the_pair_as_it_was():
    pair = layered()
    masks = {name: np.ones(pair.left.shape[:2], bool) for name in ("nonocc", "right_nonocc")}
    for mask in masks.values():
        # rows of full width are a view of the mask
        mask.flags.writeable = False
    whole = replace(pair, **masks, right_disparity=pair.disparity)
    rows, columns = pair.left.shape[:2]
    result = crop(whole, top=1, left=0, height=rows - 1, width=columns)
    assert not result.nonocc.all()
    assert not result.right_nonocc.all()


def test_crops_reach_every_place():
    image = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    pair = StereoSample("a", image, image)
    found = {random_crop(pair, np.random.default_rng(seed), height=3, width=3).left.tobytes() for seed in range(80)}
    assert len(found) == 2 * 3


@pytest.mark.parametrize(
    ("top", "left", "height", "width"), [(-1, 0, 2, 2), (0, 47, 2, 2), (0, 0, 0, 2), (31, 0, 2, 2)]
)
def test_crop_outside(top, left, height, width):
    with pytest.raises(InputError, match=r"does not lie within the image of 48 x 32"):
        crop(layered(), top=top, left=left, height=height, width=width)


def test_crop_larger_than_the_image():
    with pytest.raises(InputError, match="a crop of 64 x 32 was asked for, the image is 48 x 32; choose a smaller"):
        random_crop(layered(), np.random.default_rng(), height=32, width=64)


@given(seed=SEEDS, density=st.sampled_from([1.0, 0.3]), mask=st.booleans(), floating=st.booleans())
@settings(deadline=None)
def test_flip_keeps_the_truth(seed, density, mask, floating):
    # Without a mask, what stands before what is known as far as the left view shows it: of one board all is.
    pair = layered(seed, floating=floating, depths=(3, 6, 9) if mask else (6,))
    mask = mask or density < 1
    pair = sparse(pair, seed) if density < 1 else pair
    if mask:
        result = flip_and_swap(pair)
        np.testing.assert_array_equal(result.nonocc, np.isfinite(result.disparity))
    else:
        result = flip_and_swap(replace(pair, nonocc=None))
        assert result.nonocc is None
    np.testing.assert_array_equal(result.left, pair.right[:, ::-1])
    np.testing.assert_array_equal(result.right, pair.left[:, ::-1])
    assert errors(result).max() == 0
    known = np.isfinite(result.disparity)
    assert set(np.unique(result.disparity[known])) <= set(np.unique(pair.disparity[np.isfinite(pair.disparity)]))
    # Every seen pixel arrives once, with its object.
    seen = np.isfinite(pair.disparity) & pair.nonocc
    assert known.sum() == seen.sum()
    assert sorted(result.objects[known]) == sorted(pair.objects[seen])
    assert result.calibration.depth(4.0) == pair.calibration.depth(4.0)


@given(slope=st.floats(-0.3, 0.4), offset=st.floats(2, 8))
@settings(deadline=None)
def test_flip_keeps_a_slanted_plane(slope, offset):
    pair = slanted(offset + 15 * max(-slope, 0), slope)
    result = flip_and_swap(pair)
    # The value is that of a place at most half a pixel away, so it is off by half the slope at most.
    assert np.quantile(errors(result), 0.99) < 0.05 + 0.5 * abs(slope)
    back = flip_and_swap(result)
    known = np.isfinite(back.disparity)
    assert known.any()
    assert np.abs(back.disparity - pair.disparity)[known].max() <= 1.01 * abs(slope) + 1e-4


def test_a_far_surface_does_not_show_through_the_gaps_of_a_near_one():
    # Columns 6.. lie on a near surface that the right view sees stretched; column 0.. on a far one behind it.
    near = 6 - 0.5 * np.arange(12)
    disparity = np.full((1, 24), 0.25, np.float32)
    disparity[0, 8:20] = near + 4
    result = flip_and_swap(StereoSample("a", np.zeros((1, 24, 3)), np.zeros((1, 24, 3)), disparity))
    seen = result.disparity[0, ::-1]
    first, last = round(8 - 10.0), round(19 - 4.5)
    covered = seen[max(first, 0) : last + 1]
    assert not (covered == 0.25).any()
    assert np.isfinite(covered).any()


@given(seed=SEEDS, masks=st.booleans(), floating=st.booleans())
@settings(deadline=None)
def test_flip_with_both_truths_is_a_mirror(seed, masks, floating):
    pair = layered(seed, floating=floating, both=True)
    assert right_errors(pair).max() == 0
    pair = pair if masks else replace(pair, nonocc=None, right_nonocc=None)
    flipped = flip_and_swap(pair)
    np.testing.assert_array_equal(flipped.disparity, pair.right_disparity[:, ::-1])
    if masks:
        assert errors(flipped).max() == right_errors(flipped).max() == 0
    back = flip_and_swap(flipped)
    for part in ("left", "right", "disparity", "right_disparity", "nonocc", "right_nonocc"):
        np.testing.assert_array_equal(getattr(back, part), getattr(pair, part))
    assert back.calibration == pair.calibration


def test_flip_mirrors_the_right_truth_where_it_is_the_only_one():
    pair = replace(layered(both=True), disparity=None, nonocc=None, objects=None)
    flipped = flip_and_swap(pair)
    assert errors(flipped).max() == 0
    assert flipped.right_disparity is flipped.right_nonocc is None


def test_both_truths_carry_objects_as_one_does():
    pair = layered(both=True)
    alone = replace(pair, right_disparity=None, right_nonocc=None)
    np.testing.assert_array_equal(flip_and_swap(pair).objects, flip_and_swap(alone).objects)


@needs_shared
def test_flip_of_a_rendered_pair_fits_its_images():
    (pair,) = sceneflow(SHARED / "data" / "real" / "sceneflow")
    flipped = flip_and_swap(pair)
    assert np.isfinite(flipped.disparity).all()
    for sample, measure in ((pair, errors), (flipped, errors), (pair, right_errors), (flipped, right_errors)):
        assert np.median(measure(sample)) < 4
    wrong = replace(flipped, disparity=flipped.disparity + 2)
    assert errors(wrong).mean() > 1.3 * errors(flipped).mean()
    for part in ("left", "right", "disparity", "right_disparity"):
        np.testing.assert_array_equal(getattr(flip_and_swap(flipped), part), getattr(pair, part))


@given(seed=SEEDS)
@settings(deadline=None)
def test_the_right_truth_moves_with_the_right_view(seed):
    rng = np.random.default_rng(seed)
    pair = layered(seed, both=True)
    cropped = random_crop(pair, rng, height=20, width=30)
    assert errors(cropped).max() == right_errors(cropped).max() == 0
    assert not cropped.right_nonocc[np.arange(30) + cropped.right_disparity > 29].any()
    larger = scale(pair, height=64, width=96)
    known = np.isfinite(larger.right_disparity)
    assert known.sum() == pair.right_disparity.size
    np.testing.assert_array_equal(larger.right_disparity[known], 2 * pair.right_disparity.ravel())
    assert larger.right_nonocc.sum() == 4 * pair.right_nonocc.sum()
    down = int(rng.integers(-5, 6))
    shifted = shift_right_view(pair, down=down)
    inside = slice(max(down, 0), 32 + min(down, 0))
    for part in ("right_disparity", "right_nonocc"):
        np.testing.assert_array_equal(getattr(shifted, part)[inside], np.roll(getattr(pair, part), down, 0)[inside])
    assert np.isnan(shifted.right_disparity).sum() == abs(down) * 48
    assert not np.delete(shifted.right_nonocc, inside, axis=0).any()


@pytest.mark.parametrize(("down", "row"), [(0.4, 5), (0.6, 4), (-0.6, 6), (1.4, 4)])
def test_the_right_truth_goes_to_the_nearest_row(down, row):
    truth = np.arange(12, dtype=np.float32)[:, None] * np.ones((1, 4), np.float32)
    image = np.zeros((12, 4, 3), np.uint8)
    shifted = shift_right_view(StereoSample("a", image, image, right_disparity=truth), down=down)
    assert shifted.right_disparity[5, 0] == row


def test_flip_without_truth():
    pair = layered()
    result = flip_and_swap(StereoSample("a", pair.left, pair.right))
    assert result.disparity is result.nonocc is result.objects is result.calibration is None


@given(
    height=st.integers(12, 80),
    width=st.integers(20, 120),
    slope=st.floats(-0.05, 0.05),
    offset=st.floats(3, 8),
)
@example(height=12, width=96, slope=0.0, offset=3.0)
@settings(deadline=None)
def test_scale_keeps_the_truth(height, width, slope, offset):
    pair = slanted(offset, slope)
    result = scale(pair, height=height, width=width)
    assert result.left.shape == result.right.shape == (height, width, 3)
    assert result.left.min() >= 0
    ratio = width / 48
    allowed = 0.1 if ratio >= 0.7 else 0.25  # the waves get as short as the pixels
    assert np.quantile(errors(result), 0.95) < allowed
    for wrong in (1.0, -1.0):
        assert errors(result, result.disparity + np.float32(wrong)).mean() > errors(result).mean()
    assert result.calibration.depth(4.0 * ratio) == pytest.approx(float(pair.calibration.depth(4.0)), rel=1e-5)


@given(seed=SEEDS, height=st.integers(1, 90), width=st.integers(1, 130))
@settings(deadline=None)
def test_scale_never_interpolates_truth(seed, height, width):
    pair = sparse(layered(seed), seed)
    result = scale(pair, height=height, width=width)
    known = np.isfinite(result.disparity)
    values = result.disparity[known] / np.float32(width / 48)
    np.testing.assert_allclose(values, np.rint(values), rtol=1e-5)
    assert set(np.rint(values)) <= {1.0, 3.0, 6.0, 9.0}
    assert known.sum() <= np.isfinite(pair.disparity).sum()
    if height >= 32 and width >= 48:  # nothing is lost where there is room for all
        assert known.sum() == np.isfinite(pair.disparity).sum()
    assert set(np.unique(result.objects)) <= set(np.unique(pair.objects))
    assert result.nonocc.dtype == bool


def test_scale_to_the_same_size_is_the_pair():
    pair = layered()
    assert scale(pair, height=32, width=48) is pair
    with pytest.raises(InputError, match="scaled to 48 x 0"):
        scale(pair, height=0, width=48)


@given(seed=SEEDS)
@settings(deadline=None)
def test_random_scale_stays_in_its_range(seed):
    rng = np.random.default_rng(seed)
    height, width, _ = random_scale(layered(), rng, lowest=0.5, highest=2.0).left.shape
    assert 16 <= height <= 64
    assert abs(width / 48 - height / 32) <= 0.5 / 32 + 0.5 / 48
    height, width, _ = random_scale(layered(), rng, lowest=0.5, highest=0.6, min_height=40, min_width=50).left.shape
    assert (height, width) == (40, 60)
    for lowest, highest in ((0, 1), (2, 1), (-1, 1)):
        with pytest.raises(InputError, match="0 < lowest <= highest"):
            random_scale(layered(), rng, lowest=lowest, highest=highest)


@given(down=st.integers(-5, 5), seed=SEEDS)
@settings(deadline=None)
def test_shift_moves_the_match_down_and_not_aside(down, seed):
    pair = layered(seed)
    result = shift_right_view(pair, down=down)
    rows = slice(max(down, 0), 32 + min(down, 0))
    np.testing.assert_array_equal(result.right[rows], np.roll(pair.right, down, axis=0)[rows])
    undone = replace(result, right=np.roll(result.right, -down, axis=0))
    inner = crop(undone, top=max(-down, 0), left=0, height=32 - abs(down), width=48)
    assert errors(inner).max() == 0
    assert result.left is pair.left
    assert result.disparity is pair.disparity


def test_vertical_jitter_stays_in_its_range():
    ramp = np.repeat(np.linspace(0, 1, 32, dtype=np.float32)[:, None, None], 3, axis=2) * np.ones((1, 48, 1), "f4")
    pair = StereoSample("a", ramp, ramp)
    moves = []
    for seed in range(50):
        result = vertical_jitter(pair, np.random.default_rng(seed), largest=1.5)
        moves.append(float((ramp - result.right)[16, 20, 0]) * 31)
    assert max(np.abs(moves)) <= 1.52
    assert min(moves) < -1
    assert max(moves) > 1
