import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, MostProbable, build_model
from stereokit.candidates import most_probable
from stereokit.contracts import Distribution, Prediction
from tests.strategies import logits, seeds


def loop(logits, k):
    """Pixel by pixel, with Python's own sorting."""
    batch, levels, height, width = logits.shape
    chosen = torch.empty(batch, k, height, width, dtype=torch.long)
    mass = logits.new_empty(batch, k, height, width)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                values = logits[b, :, y, x].exp()
                order = sorted(range(levels), key=lambda d: -values[d].item())
                kept = sorted(order[:k])
                chosen[b, :, y, x] = torch.tensor(kept)
                mass[b, :, y, x] = values[kept] / values.sum()
    return chosen, mass


@given(logits(), st.data())
def test_it_equals_the_loop(logits, data):
    k = data.draw(st.integers(1, logits.shape[1]))
    levels, probability = most_probable(logits, k)
    expected, mass = loop(logits, k)
    assert torch.equal(levels, expected)
    assert_close(probability, mass)


@given(logits(), st.integers(0, 5))
def test_all_levels_are_the_softmax(logits, shift):
    levels, probability = most_probable(logits + shift, logits.shape[1])
    assert (levels == torch.arange(logits.shape[1]).reshape(-1, 1, 1)).all()
    assert_close(probability, logits.softmax(1))


def before(logits, **planes):
    return Prediction(torch.zeros(1, 4, 4), distribution=Distribution(logits, stride=4, spacing=2.0, **planes))


@given(seeds)
def test_candidates_are_in_px(seed):
    logits = torch.randn(1, 6, 2, 3, generator=torch.Generator().manual_seed(seed))
    levels, probability = most_probable(logits, 3)
    sampler = MostProbable(stride=4, planes=3)
    values, weights = sampler(None, None, before(logits, first=1.0))
    assert_close(values, 1 + 2.0 * levels)
    assert_close(weights, probability)
    planes = torch.tensor([0.0, 3.0, 4.0, 9.0, 10.0, 40.0])
    assert_close(sampler(None, None, before(logits, values=planes)).values, planes[levels])
    of_pixels = planes.reshape(1, 6, 1, 1) + torch.rand(1, 6, 2, 3)
    assert_close(sampler(None, None, before(logits, values=of_pixels)).values, of_pixels.gather(1, levels))


def test_what_it_can_not_choose_from_is_refused():
    with pytest.raises(ConfigError, match="at least 1"):
        MostProbable(stride=4, planes=0)
    with pytest.raises(ConfigError, match="there is none"):
        MostProbable(stride=4)(None, None, None)
    with pytest.raises(ConfigError, match="gives none"):
        MostProbable(stride=4)(None, None, Prediction(torch.zeros(1, 2, 2)))
    with pytest.raises(ConfigError, match="24 candidates are asked for, but the stage before has 6 planes"):
        MostProbable(stride=4)(None, None, before(torch.zeros(1, 6, 1, 1)))


def test_the_volume_is_weighted_by_the_probability():
    candidates = {"name": "most_probable", "planes": 4}
    model = build_model("psmnet", max_disparity=64, coarse=[{"stride": 4}], candidates=candidates).eval()
    seen = {}
    model.candidates.register_forward_hook(lambda _, inputs, output: seen.update(weights=output.weights))
    model.cost.register_forward_hook(lambda _, inputs, output: seen.update(volume=output))
    model.aggregation.register_forward_pre_hook(lambda _, inputs: seen.update(given=inputs[0]))
    with torch.inference_mode():
        model(*torch.rand(2, 1, 3, 64, 64))
    assert (seen["weights"] < 0.999).any()
    assert_close(seen["given"], seen["volume"] * seen["weights"].unsqueeze(1))
