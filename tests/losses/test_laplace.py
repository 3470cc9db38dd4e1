import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError
from stereokit.contracts import Distribution, Prediction
from stereokit.losses import laplace_cross_entropy, named_loss
from tests.strategies import logits, seeds


def loop(logits, truth, values, scale):
    total, count = 0.0, 0
    for b in range(len(truth)):
        for y in range(truth.shape[1]):
            for x in range(truth.shape[2]):
                g = truth[b, y, x].item()
                if not (math.isfinite(g) and g > 0):
                    continue
                q = [math.exp(-abs(g - v) / scale) / 2 for v in values]
                p = logits[b, :, y, x].softmax(0)
                total -= sum(w * math.log(p[i].item()) for i, w in enumerate(q)) / sum(q)
                count += 1
    return total / max(count, 1)


@given(logits(), st.sampled_from([0.5, 1.0, 3.0]), st.sampled_from([1.0, 2.0]), seeds)
def test_it_equals_the_loop(logits, scale, spacing, seed):
    batch, levels, height, width = logits.shape
    draw = torch.rand(batch, height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    truth = torch.where(draw < 0.2, torch.nan, draw * levels * spacing)
    given = laplace_cross_entropy(Distribution(logits, 1, spacing), truth, scale=scale)
    values = [spacing * i for i in range(levels)]
    assert math.isclose(given.item(), loop(logits, truth, values, scale), rel_tol=1e-6, abs_tol=1e-9)
    planes = torch.tensor(values, dtype=torch.float64)
    of_planes = Distribution(logits, 1, 1.0, values=planes)
    of_pixels = Distribution(logits, 1, 1.0, values=planes.reshape(1, -1, 1, 1).expand_as(logits))
    assert_close(laplace_cross_entropy(of_planes, truth, scale=scale), given)
    assert_close(laplace_cross_entropy(of_pixels, truth, scale=scale), given)


@given(seeds)
def test_the_target_itself_is_the_least(seed):
    truth = 6 * torch.rand(1, 1, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) + 0.1
    levels = torch.arange(8, dtype=torch.float64).reshape(1, -1, 1, 1)
    best = -(truth.unsqueeze(1) - levels).abs()
    noise = torch.randn(best.shape, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
    at_best, beside = (laplace_cross_entropy(Distribution(x, 1, 1.0), truth) for x in (best, best + noise))
    assert at_best < beside


def test_coarse_cells_go_by_the_pixel_in_their_middle():
    logits = torch.randn(1, 4, 2, 3)
    truth = torch.zeros(1, 7, 11)
    truth[:, 2::4, 2::4] = 5.0
    coarse = laplace_cross_entropy(Distribution(logits, 4, 4.0), truth)
    assert_close(coarse, laplace_cross_entropy(Distribution(logits, 1, 4.0), torch.full((1, 2, 3), 5.0)))


def test_nothing_known_is_zero_with_a_gradient():
    logits = torch.randn(1, 4, 2, 3, requires_grad=True)
    loss = laplace_cross_entropy(Distribution(logits, 1, 1.0), torch.full((1, 2, 3), torch.nan))
    loss.backward()
    assert loss.item() == 0
    assert not logits.grad.any()


def test_what_makes_no_sense_is_refused():
    with pytest.raises(ConfigError, match="above 0"):
        named_loss({"name": "laplace_cross_entropy", "scale": 0.0})
    with pytest.raises(ConfigError, match="'laplace_cross_entropy' is for distributions"):
        named_loss("laplace_cross_entropy")(Prediction(torch.ones(1, 2, 2)), torch.ones(1, 2, 2), max_disparity=None)
    with pytest.raises(InputError, match="wants logits"):
        laplace_cross_entropy(Distribution(torch.zeros(1, 4, 1, 1), 1, 1.0), torch.ones(1, 2, 2))
