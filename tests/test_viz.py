import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stereokit.errors import ConfigError, InputError
from stereokit.viz import colorize, picture_with_scale, robust_range

any_float32 = st.floats(width=32, allow_nan=True, allow_infinity=True)
small_maps = hnp.arrays(
    np.float32, hnp.array_shapes(min_dims=2, max_dims=2, max_side=8), elements=any_float32
)


@given(small_maps)
def test_any_map_gets_colours_and_only_unknown_pixels_are_black(disparity):
    picture = colorize(disparity)
    assert picture.shape == (*disparity.shape, 3)
    assert picture.dtype == np.uint8
    assert np.array_equal((picture == 0).all(axis=2), ~np.isfinite(disparity))


@given(small_maps)
def test_the_robust_range_is_usable_whatever_the_map(disparity):
    lo, hi = robust_range(disparity)
    assert np.isfinite([lo, hi]).all()
    assert np.float32(lo) < np.float32(hi)


def test_the_robust_range_ignores_outliers_and_spans_all_maps_given():
    disparity = np.linspace(10, 20, 10_000).reshape(100, 100)
    disparity[0, :5] = 1e6
    lo, hi = robust_range(disparity)
    assert 10 <= lo < 10.2
    assert 19.8 < hi <= 20
    lo, hi = robust_range(disparity, disparity[1:] + 50)
    assert lo < 11
    assert hi > 69


def test_a_fixed_range_is_clamped_at_both_ends_and_follows_the_colour_map():
    ramp = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    picture = colorize(np.array([[-5.0, 0.0, 51.0, 255.0, 300.0]]), value_range=(0, 255))
    assert np.array_equal(picture[0], ramp[[0, 0, 51, 255, 255]])


def test_colours_take_tensors_and_do_not_depend_on_the_number_type():
    disparity = torch.arange(12.0, requires_grad=True).reshape(3, 4)
    expected = colorize(np.arange(12, dtype=np.uint8).reshape(3, 4))
    assert np.array_equal(colorize(disparity), expected)
    assert np.array_equal(colorize(disparity.to(torch.bfloat16)), expected)


@pytest.mark.parametrize("shape", [(1, 1), (32, 24), (32, 3000), (400, 40), (375, 1242)])
def test_the_scale_stands_under_the_unchanged_picture(shape):
    disparity = np.linspace(1, 90, shape[0] * shape[1]).reshape(shape)
    picture = picture_with_scale(disparity, value_range=(0, 100))
    left = (picture.shape[1] - shape[1]) // 2
    colours = colorize(disparity, value_range=(0, 100))
    assert np.array_equal(picture[: shape[0], left : left + shape[1]], colours)
    assert shape[1] < 100 or picture.shape[1] == shape[1]
    scale = picture[shape[0] :]
    assert 30 <= scale.shape[0] <= 45 + shape[0] // 4
    dark_rows = np.flatnonzero((scale[20:] < 128).all(axis=2).any(axis=1))
    assert len(dark_rows) >= 10, "the numbers are at least ten rows high"


@settings(max_examples=40)
@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6), st.integers(1, 200))
def test_any_range_has_a_scale(lo, length, width):
    picture = picture_with_scale(np.full((4, width), lo), value_range=(lo, lo + length))
    assert picture.shape[1] >= width


def test_ticks_stand_at_their_values():
    picture = picture_with_scale(np.zeros((32, 400)), value_range=(0, 10), unit="")
    scale = picture[32:]
    bar = ~(scale[5] == 255).all(axis=1)
    start, length = np.argmax(bar), bar.sum()
    ticks = np.flatnonzero((scale[17] == 0).all(axis=1))
    assert np.allclose((ticks - start) / (length - 1) * 10, np.arange(0, 11, 2), atol=0.02)


def test_what_cannot_be_coloured_is_refused_in_one_line():
    with pytest.raises(InputError, match=r"disparity has shape \(1, 2, 3\).*take disparity\[0\]"):
        colorize(np.zeros((1, 2, 3)))
    with pytest.raises(InputError, match="expected one map of numbers"):
        colorize(np.array([["a"]]))
    with pytest.raises(InputError, match="lo < hi"):
        colorize(np.zeros((2, 2)), value_range=(3, 3))
    with pytest.raises(InputError, match="at least one"):
        robust_range()
    with pytest.raises(ConfigError, match="did you mean 'turbo'"):
        colorize(np.zeros((2, 2)), colormap="turbos")
