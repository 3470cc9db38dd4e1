from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from stereokit import ConfigError, InputError, Predictor, StereoOutput, build_model
from stereokit.cameras.consistency import occluded, right_disparity
from stereokit.evaluation import NetworkMatcher, SemiGlobalMatcher
from stereokit.inference.shifting import shift_right


class BestShift(nn.Module):
    """Finds disparities 0 to 7 by comparing colours of single pixels, as exactly as images of noise allow."""

    max_disparity = 8

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        left, right = left.float(), right.float()
        costs = [(left - right.roll(d, -1)).abs().sum(1) for d in range(8)]
        disparity = torch.stack(costs).argmin(0).float()
        return StereoOutput(disparity, confidence=torch.ones_like(disparity))


def toed_in(disparity: int, width: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """A pair in which all lies at one disparity."""
    scene = np.random.default_rng(0).integers(0, 256, (40, width + 40, 3), dtype=np.uint8)
    return scene[:, 20 : 20 + width], scene[:, 20 + disparity : 20 + disparity + width]


@given(st.integers(-9, 9), st.integers(10, 20))
def test_what_lay_in_a_column_lies_so_far_to_the_right(shift: int, width: int) -> None:
    right = torch.arange(width).expand(1, 1, 1, width)
    shifted = shift_right(right, shift)[0, 0, 0]
    for column in range(width):
        assert shifted[column] == min(max(column - shift, 0), width - 1)


@pytest.mark.parametrize("true", [-12, -6, 0, 5, 11])
def test_disparities_below_and_above_the_range_are_found_in_true_pixels(true: int) -> None:
    predict = Predictor(BestShift(), "cpu", min_disparity=true - 3)
    disparity = predict(*toed_in(true)).disparity
    inner = disparity[:, 20:-20]
    assert (inner == true).mean() > 0.99
    if true not in range(8):
        assert not (Predictor(BestShift(), "cpu")(*toed_in(true)).disparity == true).any()


def test_tiles_and_scale_keep_the_true_pixels() -> None:
    images = toed_in(-10, width=800)
    tiled = Predictor(BestShift(), "cpu", min_disparity=-12, max_memory="2MB", too_large="tile")
    assert tiled._planner.plan(40, 800).how == "tile"
    assert (tiled(*images).disparity[:, 20:-20] == -10).mean() > 0.99
    # pairs of pixels of one colour, so that half the resolution sees the same scene, at half the disparity
    doubled = [np.repeat(np.repeat(image, 2, 0), 2, 1) for image in toed_in(-4)]
    scaled = Predictor(BestShift(), "cpu", min_disparity=-10, scale=0.5)(*doubled).disparity
    assert abs(np.median(scaled[:, 40:-40]) - -8) < 1e-3


def test_the_right_view_and_the_batch_are_matched_from_the_same_disparity() -> None:
    left, right = toed_in(-10)
    predict = Predictor(BestShift(), "cpu", min_disparity=-12)
    disparity = predict(left, right).disparity
    mirrored = right_disparity(lambda a, b: predict(a, b).disparity, left, right)
    assert (mirrored[:, 20:-20] == -10).mean() > 0.99
    assert not occluded(disparity, mirrored)[:, 20:-20].any()
    batch = NetworkMatcher(predict).match_batch([left, left], [right, right])
    np.testing.assert_array_equal(batch[1], disparity)
    assert NetworkMatcher(predict).describe()["min_disparity"] == -12


@pytest.mark.slow
def test_an_exported_file_takes_it_too(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    from stereokit.export import export_onnx

    torch.manual_seed(0)
    model = build_model("coex", max_disparity=32).eval()
    export_onnx(model, tmp_path / "coex.onnx")
    left, right = toed_in(-10)
    shown = Predictor(tmp_path / "coex.onnx", "cpu", min_disparity=-12)(left, right).disparity
    expected = Predictor(model, "cpu", min_disparity=-12)(left, right).disparity
    np.testing.assert_allclose(shown, expected, atol=0.05)
    assert shown.min() >= -12


def test_the_semi_global_matcher_looks_there_too() -> None:
    for fill in (True, False):
        matcher = SemiGlobalMatcher(search_range=16, min_disparity=-16, fill=fill)
        disparity = matcher(*toed_in(-10))
        assert disparity.shape == (40, 96)
        assert np.nanmedian(disparity) == -10
        assert (np.abs(disparity + 10) < 0.5).mean() > 0.9
    assert np.nanmedian(SemiGlobalMatcher(search_range=16, min_disparity=5)(*toed_in(11))) == 11


def test_what_cannot_be_is_refused() -> None:
    for wrong in (1.5, "-3", True, None, float("nan")):
        with pytest.raises(ConfigError, match="expected a whole number of pixels"):
            Predictor(BestShift(), "cpu", min_disparity=wrong)
    for wrong in (-96, 96, 1000):
        with pytest.raises(InputError, match=r"min_disparity is -?\d+ px, and the images are 96 px wide"):
            Predictor(BestShift(), "cpu", min_disparity=wrong)(*toed_in(0))
    with pytest.raises(ConfigError, match="whole number"):
        SemiGlobalMatcher(min_disparity=0.5)
