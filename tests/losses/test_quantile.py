import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError
from stereokit.contracts import Prediction
from stereokit.losses import Quantile, masked_pinball, masked_smooth_l1
from tests.strategies import seeds

quantiles = st.sampled_from([0.05, 0.3, 0.5, 0.95])


def drawn(seed):
    generator = torch.Generator().manual_seed(seed)
    estimate, truth = 20 * torch.rand(2, 1, 4, 6, generator=generator, dtype=torch.float64) + 1
    truth[torch.rand(truth.shape, generator=generator) < 0.3] = math.nan
    truth[0, 0, 0] = 3.0
    return estimate, truth


@given(seeds, quantiles)
def test_it_equals_the_loop(seed, quantile):
    estimate, truth = drawn(seed)
    distances = [
        quantile * (g - d) if g > d else (1 - quantile) * (d - g)
        for d, g in zip(estimate.flatten().tolist(), truth.flatten().tolist(), strict=True)
        if math.isfinite(g)
    ]
    given_ = masked_pinball(estimate, truth, quantile)
    assert_close(given_, torch.tensor(sum(distances) / len(distances), dtype=torch.float64))


@given(seeds)
def test_at_one_half_it_is_half_the_distance(seed):
    estimate, truth = drawn(seed)
    known = truth.isfinite()
    assert_close(masked_pinball(estimate, truth, 0.5), (estimate - truth)[known].abs().mean() / 2)


def test_it_is_least_at_the_quantile():
    truth = torch.arange(1.0, 101.0).reshape(1, 1, -1)
    losses = [masked_pinball(torch.full_like(truth, float(d)), truth, 0.05).item() for d in range(1, 101)]
    assert losses.index(min(losses)) + 1 in (5, 6)


@given(seeds, quantiles)
def test_unknown_pixels_have_no_gradient(seed, quantile):
    estimate, truth = drawn(seed)
    unknown = ~truth.isfinite()
    estimate[unknown] = math.inf
    estimate.requires_grad_()
    masked_pinball(estimate, truth, quantile).backward()
    assert (estimate.grad[unknown] == 0).all()
    assert (estimate.grad[~unknown] != 0).any()


def test_a_prediction_without_a_quantile_is_held_to_smooth_l1():
    estimate, truth = drawn(0)
    plain = masked_smooth_l1(estimate, truth)
    assert_close(Quantile()(Prediction(estimate), truth, max_disparity=None), plain)
    both = Quantile(share=0.7)(Prediction(estimate, quantile=0.95), truth, max_disparity=None)
    assert_close(both, masked_pinball(estimate, truth, 0.95) + 0.7 * plain)


def test_what_has_no_meaning_is_refused():
    with pytest.raises(ConfigError, match="share"):
        Quantile(share=-1)
    with pytest.raises(InputError, match="between 0 and 1"):
        masked_pinball(torch.ones(1, 1, 1), torch.ones(1, 1, 1), 1.0)
    with pytest.raises(InputError, match="shape"):
        masked_pinball(torch.ones(1, 1, 2), torch.ones(1, 1, 1), 0.5)
