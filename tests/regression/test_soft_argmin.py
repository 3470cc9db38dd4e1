import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError, SoftArgmin, TopKSoftArgmin
from stereokit.regression import soft_argmin, top_k_mass, top_k_soft_argmin
from tests.strategies import logits, randn, seeds


@st.composite
def logits_and_k(draw, **kwargs):
    drawn = draw(logits(**kwargs))
    return drawn, draw(st.integers(1, drawn.shape[1]))


def loop(volume, k, candidates):
    """Per pixel: sort, keep k, softmax, expectation."""
    batch, _, height, width = volume.shape
    out = volume.new_zeros(batch, height, width)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                kept = sorted(zip(volume[b, :, y, x].tolist(), candidates[b, :, y, x].tolist(), strict=True))[-k:]
                weights = [pow(2.718281828459045, value - kept[-1][0]) for value, _ in kept]
                out[b, y, x] = sum(w * c for w, (_, c) in zip(weights, kept, strict=True)) / sum(weights)
    return out


def levels_of(volume):
    return torch.arange(volume.shape[1], dtype=volume.dtype).reshape(1, -1, 1, 1).expand_as(volume)


@given(logits())
def test_soft_argmin_equals_the_loop(volume):
    assert_close(soft_argmin(volume), loop(volume, volume.shape[1], levels_of(volume)))


@given(logits_and_k())
def test_top_k_equals_the_loop(drawn):
    volume, k = drawn
    assert_close(top_k_soft_argmin(volume, k), loop(volume, k, levels_of(volume)))


@given(logits_and_k(), seeds)
def test_candidates_may_differ_by_pixel(drawn, seed):
    volume, k = drawn
    candidates = 100 * randn(seed, *volume.shape, dtype=volume.dtype)
    assert_close(top_k_soft_argmin(volume, k, candidates), loop(volume, k, candidates))
    assert_close(soft_argmin(volume, candidates), loop(volume, volume.shape[1], candidates))


@given(logits_and_k(), seeds)
def test_candidates_may_be_shared_by_all_pixels(drawn, seed):
    volume, k = drawn
    candidates = randn(seed, volume.shape[1], dtype=volume.dtype)
    spread = candidates.reshape(1, -1, 1, 1).expand_as(volume)
    assert_close(top_k_soft_argmin(volume, k, candidates), loop(volume, k, spread))
    assert_close(top_k_soft_argmin(volume, k, candidates.reshape(1, -1, 1, 1)), loop(volume, k, spread))
    assert_close(soft_argmin(volume, candidates), loop(volume, volume.shape[1], spread))


@given(logits())
def test_all_levels_kept_is_soft_argmin(volume):
    assert_close(top_k_soft_argmin(volume, volume.shape[1]), soft_argmin(volume))


@given(logits())
def test_one_level_kept_is_argmax(volume):
    assert_close(top_k_soft_argmin(volume, 1), volume.argmax(1).to(volume.dtype))


@given(logits_and_k())
def test_the_result_lies_within_the_kept(drawn):
    volume, k = drawn
    kept = volume.topk(k, dim=1).indices
    result = top_k_soft_argmin(volume, k)
    assert (result >= kept.amin(1) - 1e-9).all()
    assert (result <= kept.amax(1) + 1e-9).all()


@given(logits_and_k(), st.floats(-1e3, 1e3))
def test_a_constant_changes_nothing(drawn, constant):
    volume, k = drawn
    assert_close(top_k_soft_argmin(volume + constant, k), top_k_soft_argmin(volume, k), rtol=0, atol=1e-8)


@given(logits_and_k())
def test_a_shift_by_one_level_shifts_by_one(drawn):
    volume, k = drawn
    lowest = volume.amin(1, keepdim=True) - 1000
    above, below = torch.cat((volume, lowest), 1), torch.cat((lowest, volume), 1)
    assert_close(top_k_soft_argmin(below, k), top_k_soft_argmin(above, k) + 1)
    assert_close(soft_argmin(below), soft_argmin(above) + 1)


@given(logits_and_k(min_levels=2))
def test_gradients_reach_the_kept_alone(drawn):
    volume, k = drawn
    volume.requires_grad_()
    # different candidates and weights in play: at every pixel each kept logit moves the result
    top_k_soft_argmin(0.01 * volume, k).sum().backward()
    kept = torch.zeros_like(volume).scatter(1, volume.topk(k, dim=1).indices, 1).bool()
    assert (volume.grad[~kept] == 0).all()
    if k > 1:
        assert (volume.grad != 0).any(1).all()
    else:
        assert (volume.grad == 0).all()


def test_gradients_are_right():
    volume = torch.randn(1, 5, 2, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(soft_argmin, (volume,))
    for k in range(1, 6):
        assert torch.autograd.gradcheck(lambda x, k=k: top_k_soft_argmin(x, k), (volume,))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("k", [1, 2, 200])
def test_half_precision_gives_single(dtype, k):
    # 151 and 152 are no neighbours in bfloat16
    volume = torch.full((1, 200, 1, 1), -1000.0).to(dtype)
    volume[:, 151:153] = 5
    module = TopKSoftArgmin(k)
    result = module(volume)
    assert result.dtype == torch.float32
    assert result.item() == pytest.approx(151.5 if k > 1 else 151, abs=1e-3)
    assert module.with_confidence(volume)[1].dtype == torch.float32
    assert SoftArgmin()(volume).dtype == SoftArgmin().with_confidence(volume)[1].dtype == torch.float32


@pytest.mark.parametrize("function", [soft_argmin, lambda x: top_k_soft_argmin(x, 2), lambda x: top_k_mass(x, 2)])
def test_double_precision_stays(function):
    assert function(torch.rand(1, 4, 1, 1, dtype=torch.float64)).dtype == torch.float64


@given(logits_and_k())
def test_mass_is_the_softmax_over_the_kept(drawn):
    volume, k = drawn
    mass = top_k_mass(volume, k)
    assert_close(mass, volume.softmax(1).sort(1, descending=True).values[:, :k].sum(1))
    assert (mass <= 1).all()
    assert (mass >= k / volume.shape[1] - 1e-9).all()


@given(logits())
def test_confidence_of_soft_argmin_is_the_mass_near_the_estimate(volume):
    levels = volume.shape[1]
    probability, estimate = volume.softmax(1), soft_argmin(volume)
    expected = torch.zeros_like(estimate)
    for b, y, x in itertools.product(*map(range, estimate.shape)):
        below = int(estimate[b, y, x])
        nearest = range(max(0, below - 1), min(levels, below + 3))
        expected[b, y, x] = sum(probability[b, d, y, x] for d in nearest)
    confidence = SoftArgmin().with_confidence(volume)[1]
    assert_close(confidence, expected)
    assert (confidence <= 1).all()


def test_confidence_is_low_between_two_peaks():
    volume = torch.full((1, 20, 1, 2), -50.0)
    volume[0, [2, 17], 0, 0] = 50
    volume[0, 9, 0, 1] = 50
    two, one = SoftArgmin().with_confidence(volume)[1][0, 0]
    assert two < 1e-3
    assert one > 0.999


def test_test_k_counts_in_eval_mode():
    volume = torch.randn(1, 9, 2, 2)
    module = TopKSoftArgmin(5, test_k=2)
    assert_close(module(volume), top_k_soft_argmin(volume, 5))
    assert_close(module.with_confidence(volume)[1], top_k_mass(volume, 5))
    module.eval()
    assert_close(module(volume), top_k_soft_argmin(volume, 2))
    assert_close(module.with_confidence(volume)[0], top_k_soft_argmin(volume, 2))
    assert_close(module.with_confidence(volume)[1], top_k_mass(volume, 2))
    assert module.min_levels == 5
    assert TopKSoftArgmin(2, test_k=5).min_levels == 5
    assert TopKSoftArgmin(3).test_k == 3
    assert "k=5, test_k=2" in repr(module)


@pytest.mark.parametrize("k", [0, -1, 6, 100])
@pytest.mark.parametrize("function", [top_k_soft_argmin, top_k_mass])
def test_k_out_of_range_is_refused(function, k):
    with pytest.raises(InputError, match=rf"k={k} is outside 1\.\.5"):
        function(torch.rand(1, 5, 2, 2), k)


@pytest.mark.parametrize("function", [soft_argmin, lambda x: top_k_soft_argmin(x, 1), lambda x: top_k_mass(x, 1)])
def test_a_volume_with_its_channel_is_refused(function):
    with pytest.raises(InputError, match=r"\(B, D, H, W\); got \(1, 1, 5, 2, 2\)"):
        function(torch.rand(1, 1, 5, 2, 2))


@pytest.mark.parametrize("arguments", [{"k": k} for k in (0, -3, 1.5, "2", True)] + [{"k": 1, "test_k": 0}])
def test_k_is_a_positive_whole_number(arguments):
    with pytest.raises(ConfigError, match="whole number"):
        TopKSoftArgmin(**arguments)


@given(logits(), seeds)
def test_stretched_candidates_reach_the_end_of_the_range(volume, seed):
    levels = volume.shape[1]
    regression = SoftArgmin(include_end=True)
    assert regression.min_levels == 2
    assert SoftArgmin().min_levels == 1
    candidates = randn(seed, levels, dtype=volume.dtype)
    # given candidates stay as they are
    assert_close(regression(volume, candidates), soft_argmin(volume, candidates))
    if levels > 1:
        stretched = torch.linspace(0, levels, levels, dtype=volume.dtype)
        assert_close(regression(volume), soft_argmin(volume, stretched))
        assert_close(regression.with_confidence(volume)[0], soft_argmin(volume, stretched))
