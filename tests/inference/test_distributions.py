import numpy as np
import pytest
import torch

from stereokit import ConfigError, InputError, Predictor, build_model


def pair(height=50, width=70, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (2, height, width, 3), dtype=np.uint8)


def predictor(name="psmnet", scale=1.0, **choices):
    torch.manual_seed(0)
    return Predictor(build_model(name, max_disparity=64, **choices), "cpu", scale=scale)


@pytest.mark.parametrize(
    ("name", "choices"),
    [
        ("psmnet", {}),
        ("coex", {"upsampler": "trilinear", "top_k": 6}),
        ("coex", {"upsampler": "trilinear", "corner": "top_right"}),
        ("coex", {"upsampler": "trilinear"}),
    ],
)
def test_the_expectation_is_the_disparity_where_nothing_comes_after_the_regression(name, choices):
    match = predictor(name, **choices)
    left, right = pair()
    expected = match(left, right).disparity
    rows, columns = np.array([0, 0, 17, 40, 49]), np.array([0, 69, 33, 60, 69])
    found = match.distributions(left, right).at(rows, columns)
    np.testing.assert_allclose(found.expectation, expected[rows, columns], rtol=1e-3, atol=5e-3)
    np.testing.assert_allclose(found.probabilities.sum(1), 1, atol=1e-5)
    assert (found.kept.sum(1) == match.model.regression.test_k if "top_k" in choices else found.kept.any()).all()


def test_the_kept_candidates_are_the_likeliest_and_give_the_expectation():
    found = predictor("coex").distributions(*pair()).at([20, 45], [30, 65])
    assert found.disparities[0].tolist() == list(range(0, 64, 4))
    assert (found.kept.sum(1) == 2).all()
    for n in range(2):
        kept, chances = found.kept[n], found.probabilities[n]
        assert chances[kept].min() >= chances[~kept].max()
        mean = np.average(found.disparities[n][kept], weights=chances[kept])
        assert found.expectation[n] == pytest.approx(mean, abs=1e-3)
        assert found.spread[n] ** 2 == pytest.approx(
            (chances * found.disparities[n] ** 2).sum() - (chances * found.disparities[n]).sum() ** 2, rel=1e-3
        )


def test_a_scaled_pair_says_disparities_of_the_given_one():
    match = predictor("coex", upsampler="trilinear", scale=0.5)
    left, right = pair(100, 140)
    found = match.distributions(left, right).at([51], [71])
    assert found.disparities.max() == pytest.approx(126)
    # the result is interpolated between pixels of the scaled pair, all of which nearly agree here
    assert found.expectation[0] == pytest.approx(match(left, right).disparity[51, 71], abs=1)


def test_candidates_of_each_pixel_are_their_own():
    found = predictor("casstereo_psm").distributions(*pair(64, 128)).at([10, 40], [20, 100])
    assert (found.disparities >= 0).all()
    low, high = found.disparities.min(1), found.disparities.max(1)
    assert ((low <= found.expectation + 1e-3) & (found.expectation - 1e-3 <= high)).all()


def test_what_has_no_distribution_says_so():
    with pytest.raises(ConfigError, match="gives no distribution"):
        predictor("dispnetc").distributions(*pair())


def test_pixels_outside_are_refused():
    found = predictor("coex").distributions(*pair())
    for row, column in ((50, 0), (0, 70), (-1, 0), (1.5, 0)):
        with pytest.raises(InputError, match="whole number from 0 to"):
            found.at([row], [column])
