import importlib.util
import sys

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stereokit.errors import ConfigError, InputError
from stereokit.pictures import (
    KITTI_ERROR_COLORS,
    captioned,
    colorize,
    distribution_figure,
    error_picture,
    overlay,
    picture_with_scale,
    robust_range,
)

any_float32 = st.floats(width=32, allow_nan=True, allow_infinity=True)
small_maps = hnp.arrays(np.float32, hnp.array_shapes(min_dims=2, max_dims=2, max_side=8), elements=any_float32)


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
    # narrower ones are as wide as their scale
    assert (picture.shape[1] == shape[1]) == (shape[1] >= 100)
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


MAGENTA, BLACK = (255, 0, 255), (0, 0, 0)
disparities = st.floats(0.5, 300, width=32)


@given(st.lists(st.tuples(disparities, disparities), min_size=1, max_size=30))
def test_the_error_picture_follows_the_table_and_is_warm_exactly_for_outliers(pairs):
    prediction, truth = np.array(pairs, np.float32).T[:, None]
    picture = error_picture(prediction, truth, dilate=0)[0]
    for color, estimate, true in zip(picture.tolist(), *np.array(pairs).T.tolist(), strict=True):
        error = min(abs(estimate - true), 60 * abs(estimate - true) / true)
        assert tuple(color) == next(rgb for limit, rgb in KITTI_ERROR_COLORS if error <= limit)
        outlier = abs(estimate - true) > 3 and 20 * abs(estimate - true) > true
        assert (color[0] > color[2]) == outlier


def test_an_error_on_the_threshold_is_no_outlier():
    # 3 px of 10, and 5 % of 100.
    picture = error_picture([[13.0, 105.0, 13.01, 105.01]], [[10.0, 100.0, 10.0, 100.0]], dilate=0)
    assert (picture[0, :, 0] > picture[0, :, 2]).tolist() == [False, False, True, True]


def test_unknown_truth_is_black_and_a_missing_prediction_magenta():
    truth = np.array([[0.0, np.nan, np.inf, -1.0, 5.0, 5.0]])
    prediction = np.array([[5.0, 5.0, np.nan, 5.0, np.nan, np.inf]])
    picture = error_picture(prediction, truth, dilate=0)
    assert [tuple(c) for c in picture[0].tolist()] == [BLACK] * 4 + [MAGENTA] * 2


def test_dilation_fills_only_unknown_pixels_and_the_worst_neighbour_wins():
    truth = np.full((5, 7), np.nan)
    truth[2, 1:3], truth[2, 4:6] = 50, 50
    prediction = np.full((5, 7), 50.0)
    prediction[2, 4] = 150
    thin, thick = error_picture(prediction, truth, dilate=0), error_picture(prediction, truth)
    right, wrong = KITTI_ERROR_COLORS[0][1], KITTI_ERROR_COLORS[-1][1]
    known = np.isfinite(truth)
    assert np.array_equal(thick[known], thin[known])
    assert (thin[~known] == 0).all()
    assert tuple(thick[2, 5]) == right, "its neighbour is wrong, it is not"
    assert tuple(thick[2, 0]) == right
    assert tuple(thick[2, 3]) == wrong
    assert tuple(thick[0, 2]) == BLACK


def test_occluded_pixels_are_half_as_bright():
    truth = np.array([[50.0, 50.0, 0.0, 50.0]])
    prediction = np.array([[50.0, 54.0, 54.0, np.nan]])
    occluded = np.array([[False, True, True, True]])
    plain = error_picture(prediction, truth, dilate=0)
    picture = error_picture(prediction, truth, occluded=occluded, dilate=0)
    assert np.array_equal(picture[~occluded], plain[~occluded])
    assert np.array_equal(picture[occluded], plain[occluded] // 2)
    with pytest.raises(InputError, match="occluded is float64"):
        error_picture(prediction, truth, occluded=truth)


def test_an_overlay_mixes_known_pixels_only():
    image = np.full((2, 3, 3), 200, np.uint8)
    disparity = np.array([[1.0, 2.0, np.nan], [np.inf, 3.0, 4.0]])
    known = np.isfinite(disparity)
    assert np.array_equal(overlay(image, disparity, opacity=0), image)
    full = overlay(image, disparity, opacity=1)
    assert np.array_equal(full[known], colorize(disparity)[known])
    half = overlay(image, disparity)
    assert np.array_equal(half[~known], image[~known])
    assert np.abs(half[known] - (full[known] / 2 + 100)).max() <= 0.5
    assert np.array_equal(overlay(image / np.float32(255), disparity), half)


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (np.zeros((3, 2, 3), np.uint8), "disparity's size"),
        (np.zeros((2, 3), np.uint8), "expected RGB"),
        (np.zeros((2, 3, 3), np.uint16), "uint16"),
        (np.full((2, 3, 3), 200.0), r"values in \[0, 1\]"),
        (np.full((2, 3, 3), np.nan), r"values in \[0, 1\]"),
    ],
)
def test_an_overlay_refuses_other_images(image, said):
    with pytest.raises(InputError, match=said):
        overlay(image, np.ones((2, 3)))


needs_matplotlib = pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="needs matplotlib")


def two_peaks():
    logits = np.full((6, 3, 4), -20.0)
    logits[1], logits[4, :, 2:] = 0.0, np.log(3.0)
    return logits


def lines_of(panel):
    return {line.get_color(): line.get_xdata()[0] for line in panel.lines}


@needs_matplotlib
@pytest.mark.parametrize("probabilities", [False, True])
def test_the_distribution_figure_shows_candidates_kept_estimate_and_truth(probabilities, tmp_path):
    logits = two_peaks()
    values = np.exp(logits) / np.exp(logits).sum(axis=0) if probabilities else torch.from_numpy(logits)
    truth = np.zeros((12, 16))
    truth[9, 14] = 14.5
    figure = distribution_figure(values, [(14, 9), (0, 0)], k=2, stride=4, truth=truth, probabilities=probabilities)
    first, second = figure.axes
    left_out, kept = first.containers
    assert sorted(bar.get_x() + bar.get_width() / 2 for bar in kept) == pytest.approx([4, 16])
    assert sorted(bar.get_height() for bar in kept) == pytest.approx([0.25, 0.75], abs=1e-6)
    assert len(left_out) == 4
    assert lines_of(first) == pytest.approx({"tab:red": 13.0, "tab:green": 14.5})
    assert lines_of(second)["tab:red"] == pytest.approx(4.0, abs=1e-5)
    assert "tab:green" not in lines_of(second), "unknown truth draws no line"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "left out",
        "top 2",
        "truth",
        "estimate",
    ]
    figure.savefig(tmp_path / "figure.png", dpi=50)
    assert cv2.imread(str(tmp_path / "figure.png")) is not None


@needs_matplotlib
def test_the_distribution_figure_takes_candidates_and_the_networks_own_estimate():
    logits = two_peaks()
    candidates = np.broadcast_to(np.linspace(10, 60, 6)[:, None, None], logits.shape)
    for levels in (candidates, candidates[:, 0, 0]):
        (panel,) = distribution_figure(logits, [(3, 0)], k=1, candidates=levels).axes
        assert lines_of(panel) == {"tab:red": pytest.approx(50.0)}
    (panel,) = distribution_figure(logits, [(3, 0)], estimate=np.full((3, 4), 47.0)).axes
    assert lines_of(panel) == {"tab:red": 47.0}
    assert len(panel.containers) == 1, "soft-argmin leaves no candidate out"


@needs_matplotlib
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"logits": np.zeros((2, 4))}, "expected those of one image"),
        ({"k": 0}, "expected 1 to 6"),
        ({"k": 7}, "expected 1 to 6"),
        ({"pixels": []}, "at least one"),
        ({"pixels": [(4, 0)]}, r"pixel \(4, 0\) is outside; expected 0 <= x < 4"),
        ({"probabilities": True}, "do not sum to 1"),
        ({"candidates": np.zeros(5)}, r"expected \(6,\)"),
        ({"truth": np.zeros((1, 3, 4))}, "expected one map"),
        ({"logits": np.full((6, 3, 4), np.nan)}, "not finite"),
        ({"stride": 0}, "stride is 0"),
    ],
)
def test_the_distribution_figure_refuses_what_does_not_fit(change, said):
    arguments = {"logits": two_peaks(), "pixels": [(0, 0)], **change}
    with pytest.raises(InputError, match=said):
        distribution_figure(**arguments)


def test_without_matplotlib_the_figure_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ConfigError, match=r'pip install "stereokit\[viz\]"'):
        distribution_figure(two_peaks(), [(0, 0)])


def test_a_caption_stands_in_the_corner_of_a_copy():
    picture = np.full((96, 160, 3), 100, np.uint8)
    error, truth = (captioned(picture, text) for text in ("error", "ground truth"))
    assert (picture == 100).all()
    assert {0, 255} <= set(np.unique(error[:20, :40]))
    assert (error[40:] == 100).all()
    assert (error[:20] != 100).sum() < (truth[:20] != 100).sum()
    assert captioned(picture[:5, :7], "cut off").shape == (5, 7, 3)
