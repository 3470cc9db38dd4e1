import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError
from stereokit.contracts import Distribution, Prediction
from stereokit.losses import (
    confidence_loss,
    laplace_cross_entropy,
    masked_smooth_l1,
    named_loss,
    stereo_focal_loss,
    unimodal_target,
)
from tests.strategies import logits, randn, seeds


def truth_for(logits, spacing, seed):
    """Truth from 0 to the last plane, one pixel in five unknown."""
    batch, levels, height, width = logits.shape
    draw = torch.rand(batch, height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.where(draw < 0.2, torch.nan, draw * levels * spacing)


def loop(logits, truth, spacing, scale, focus):
    total, count = 0.0, 0
    for b, y, x in torch.cartesian_prod(*(torch.arange(n) for n in truth.shape)).tolist():
        g = truth[b, y, x].item()
        if not (math.isfinite(g) and g > 0):
            continue
        width = scale[b, y, x].item()
        weights = [math.exp(-abs(g / spacing - level) / width) for level in range(logits.shape[1])]
        log_mass = logits[b, :, y, x].log_softmax(0).tolist()
        for weight, value in zip(weights, log_mass, strict=True):
            share = weight / sum(weights)
            total -= (1 - share) ** -focus * share * value
        count += 1
    return total / max(count, 1)


@given(logits(min_levels=2), st.sampled_from([0.0, 2.0, 5.0]), st.sampled_from([1.0, 4.0]), seeds)
def test_it_equals_the_loop(logits, focus, spacing, seed):
    truth = truth_for(logits, spacing, seed)
    scale = 1 + randn(seed, *truth.shape, dtype=torch.float64).sigmoid()
    expected = loop(logits, truth, spacing, scale, focus)
    given = stereo_focal_loss(Distribution(logits, 1, spacing), truth, scale=scale, focus=focus)
    assert given.item() == pytest.approx(expected, rel=1e-6, abs=1e-9)
    planes = spacing * torch.arange(logits.shape[1], dtype=torch.float64)
    for values in (planes, planes.reshape(1, -1, 1, 1).expand_as(logits)):
        assert_close(
            stereo_focal_loss(Distribution(logits, 1, 9.0, values=values), truth, scale=scale, focus=focus), given
        )


@given(logits(min_levels=2), seeds)
def test_without_focus_it_is_the_cross_entropy_with_a_laplace_distribution(logits, seed):
    truth = truth_for(logits, 1.0, seed)
    distribution = Distribution(logits, 1, 1.0)
    expected = laplace_cross_entropy(distribution, truth, scale=1.5)
    assert_close(stereo_focal_loss(distribution, truth, scale=1.5, focus=0.0), expected)


@given(st.floats(0, 9), st.floats(0.3, 3))
def test_the_target_has_one_peak_at_the_truth(truth, scale):
    levels = torch.arange(10, dtype=torch.float64).reshape(1, -1, 1, 1)
    target = unimodal_target(levels, torch.full((1, 1, 1), truth, dtype=torch.float64), scale).flatten()
    assert target.sum().item() == pytest.approx(1)
    best = target.argmax().item()
    assert abs(best - truth) <= 0.5
    assert (target[: best + 1].diff() >= 0).all()
    assert (target[best:].diff() <= 0).all()


def test_gradients_are_right():
    logits = torch.randn(1, 5, 2, 3, dtype=torch.float64, requires_grad=True)
    scale = (1 + torch.rand(1, 2, 3, dtype=torch.float64)).requires_grad_()
    truth = torch.tensor([[[0.7, 1.2, torch.nan], [2.6, 3.1, 0.3]]], dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda x, b: stereo_focal_loss(Distribution(x, 1, 1.0), truth, scale=b), (logits, scale)
    )


def test_the_loss_is_its_three_parts():
    logits, certainty = torch.randn(1, 5, 2, 3, requires_grad=True), torch.randn(1, 2, 3, requires_grad=True)
    disparity, truth = 4 * torch.rand(1, 2, 3), 4 * torch.rand(1, 2, 3)
    truth[0, 0, 1] = torch.nan
    head = Distribution(logits, 1, 1.0, certainty=certainty)
    scale = 1.5 + 1.5 * (1 - certainty.sigmoid())
    expected = (
        stereo_focal_loss(head, truth, scale=scale, focus=3.0)
        + 0.2 * masked_smooth_l1(disparity, truth)
        + 4 * confidence_loss(certainty, truth.isfinite())
    )
    loss = named_loss(
        {"name": "stereo_focal", "focus": 3, "narrowest": 1.5, "widest": 3, "smooth_l1": 0.2, "confidence": 4}
    )
    given = loss(Prediction(disparity, 1, head), truth, max_disparity=None)
    assert_close(given, expected)
    inputs = (logits, certainty)
    assert_close(torch.autograd.grad(given, inputs), torch.autograd.grad(expected, inputs))
    uniform = named_loss({"name": "stereo_focal", "scale": 0.8, "smooth_l1": 0.0})
    plain = Distribution(logits, 1, 1.0)
    expected = stereo_focal_loss(plain, truth, scale=0.8)
    assert_close(uniform(Prediction(disparity, 1, plain), truth, max_disparity=None), expected)


def test_confidence_is_log_loss_over_the_known():
    certainty = torch.tensor([[[0.0, 3.0, torch.nan]]], requires_grad=True)
    loss = confidence_loss(certainty, torch.tensor([[[True, True, False]]]))
    loss.backward()
    assert loss.item() == pytest.approx((math.log(2) + math.log1p(math.exp(-3))) / 2, rel=1e-5)
    assert certainty.grad[0, 0, 2] == 0
    assert certainty.grad[0, 0, 0].item() == pytest.approx(-0.25)


def test_nothing_known_is_zero_with_a_gradient():
    logits = torch.randn(1, 4, 2, 3, requires_grad=True)
    loss = stereo_focal_loss(Distribution(logits, 1, 1.0), torch.full((1, 2, 3), torch.nan))
    loss.backward()
    assert loss.item() == 0
    assert not logits.grad.any()


def test_what_makes_no_sense_is_refused():
    for name, value in {
        "focus": -1,
        "scale": 0,
        "narrowest": 0,
        "widest": 0.5,
        "smooth_l1": -1,
        "confidence": -2,
    }.items():
        with pytest.raises(ConfigError, match=name):
            named_loss({"name": "stereo_focal", name: value})
    with pytest.raises(ConfigError, match="'stereo_focal' is for distributions"):
        named_loss("stereo_focal")(Prediction(torch.ones(1, 2, 2)), torch.ones(1, 2, 2), max_disparity=None)
    with pytest.raises(InputError, match="two levels"):
        stereo_focal_loss(Distribution(torch.zeros(1, 1, 1, 1), 1, 1.0), torch.ones(1, 1, 1))
    with pytest.raises(InputError, match="wants logits"):
        stereo_focal_loss(Distribution(torch.zeros(1, 4, 1, 1), 1, 1.0), torch.ones(1, 2, 2))
