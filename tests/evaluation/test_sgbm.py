from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from stereokit.data import read_disparity, read_image
from stereokit.errors import ConfigError, InputError
from stereokit.evaluation import SGBM_VARIANTS, SemiGlobalMatcher, fill_from_background
from tests.shared import SHARED, needs_shared


def shifted(disparity, size=(60, 200), dtype=np.uint8):
    rng = np.random.default_rng(0)
    wide = rng.integers(0, 256, (size[0], size[1] + disparity, 3), dtype=np.uint8)
    left, right = wide[:, : size[1]], wide[:, disparity:]
    return (left, right) if dtype == np.uint8 else (left / np.float32(255), right / np.float32(255))


@pytest.mark.parametrize("name", SGBM_VARIANTS)
@pytest.mark.parametrize("disparity", [0, 1, 50])
def test_it_finds_a_shift_up_to_the_left_border(name, disparity):
    left, right = shifted(disparity)
    found = SGBM_VARIANTS[name](left, right)
    assert found.dtype == np.float32
    assert found.shape == left.shape[:2]
    # these columns are beyond the right image's left border and have no match
    seen = found[:, disparity:]
    assert np.nanmedian(seen) == disparity
    assert np.nanmean(np.abs(seen[:, :10] - disparity) <= 1) > 0.9
    if name.endswith("unfilled"):
        assert np.isnan(found).any() == (disparity == 50)
    else:
        assert np.isfinite(found).all()


def test_the_whole_search_range_is_searched_and_no_more():
    left, right = shifted(30)
    assert np.nanmedian(SemiGlobalMatcher(search_range=31)(left, right)[:, 30:]) == 30
    narrow = SemiGlobalMatcher(search_range=16, fill=False)(left, right)
    assert not (np.abs(narrow - 30) < 2).any()


@pytest.mark.parametrize(
    ("paths", "mode"), [(8, cv2.STEREO_SGBM_MODE_HH), (5, cv2.STEREO_SGBM_MODE_SGBM)], ids=["8", "5"]
)
def test_paths_and_penalties_reach_opencv(monkeypatch, paths, mode):
    create, given_to = cv2.StereoSGBM.create, []
    recorder = SimpleNamespace(create=lambda **arguments: given_to.append(arguments) or create(**arguments))
    monkeypatch.setattr(cv2, "StereoSGBM", recorder)
    SemiGlobalMatcher(paths=paths, search_range=20, block_size=5)(*shifted(5))
    [arguments] = given_to
    assert arguments["mode"] == mode
    assert (arguments["numDisparities"], arguments["blockSize"]) == (32, 5)
    assert (arguments["P1"], arguments["P2"]) == (8 * 3 * 25, 32 * 3 * 25)


def test_images_of_either_depth_give_the_same():
    eight, sixteen = (SGBM_VARIANTS["sgbm"](*shifted(5, dtype=dtype)) for dtype in (np.uint8, np.float32))
    np.testing.assert_array_equal(eight, sixteen)


@pytest.mark.parametrize("arguments", [{"paths": 4}, {"search_range": 0}, {"block_size": 4}, {"block_size": 0}])
def test_parameters_that_can_not_be_are_refused(arguments):
    with pytest.raises(ConfigError, match=next(iter(arguments))):
        SemiGlobalMatcher(**arguments)


def test_images_of_two_sizes_are_refused():
    with pytest.raises(InputError, match="one shape"):
        SemiGlobalMatcher()(np.zeros((40, 60, 3), np.uint8), np.zeros((40, 61, 3), np.uint8))


def test_holes_take_the_farther_neighbour():
    hole = np.nan
    given_map = np.array([[hole, 9, hole, 4, hole], [hole] * 5, [hole] * 5, [7, hole, 8, 8, hole]])
    expected = [[9, 9, 4, 4, 4], [9, 9, 4, 4, 4], [7, 7, 8, 8, 8], [7, 7, 8, 8, 8]]
    np.testing.assert_array_equal(fill_from_background(given_map), expected)
    assert np.isnan(fill_from_background(np.full((3, 4), np.inf))).all()


@settings(max_examples=50, deadline=None)
@given(
    arrays(
        np.float32,
        array_shapes(min_dims=2, max_dims=2, max_side=8),
        elements=st.one_of(st.just(np.nan), st.floats(0, 100, width=32)),
    )
)
def test_filling_keeps_estimates_and_leaves_no_hole(disparity):
    filled = fill_from_background(disparity)
    known = np.isfinite(disparity)
    np.testing.assert_array_equal(filled[known], disparity[known])
    assert np.isfinite(filled).all() == known.any()
    assert np.isin(filled[np.isfinite(filled)], disparity).all()


@needs_shared
def test_it_matches_a_real_pair():
    scene = SHARED / "data/real/middlebury/teddy"
    left, right = (read_image(scene / f"im{view}.png") for view in "LR")
    truth = read_disparity(scene / "groundtruth.png", scale=4)
    known = np.isfinite(truth)
    bad = {
        name: 100 * (~(np.abs(SGBM_VARIANTS[name](left, right) - truth)[known] <= 3)).mean()
        for name in ("sgbm", "sgbm_unfilled")
    }
    assert bad["sgbm"] == pytest.approx(8.4, abs=0.5)
    assert bad["sgbm_unfilled"] > bad["sgbm"] + 3
