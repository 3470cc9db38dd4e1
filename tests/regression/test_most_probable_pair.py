import math

import pytest
import torch
from hypothesis import given
from torch.testing import assert_close

from stereokit import InputError, MostProbablePair
from stereokit.regression import most_probable_pair, top_k_soft_argmin
from tests.strategies import logits, seeds


def loop(logits, values):
    """Pixel by pixel; the estimate, and the probability of the pair."""
    batch, levels, height, width = logits.shape
    estimate, mass = torch.empty(2, batch, height, width, dtype=logits.dtype)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                column = [v.item() for v in logits[b, :, y, x]]
                weight = [math.exp(v - max(column)) for v in column]
                pairs = [weight[d] + weight[d + 1] for d in range(levels - 1)]
                k = pairs.index(max(pairs))
                at = [values[b, d, y, x].item() for d in (k, k + 1)]
                estimate[b, y, x] = (weight[k] * at[0] + weight[k + 1] * at[1]) / pairs[k]
                mass[b, y, x] = pairs[k] / sum(weight)
    return estimate, mass


@given(logits(min_levels=2), seeds)
def test_it_equals_the_loop(logits, seed):
    values = torch.rand(logits.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    expected, mass = loop(logits, values)
    assert_close(most_probable_pair(logits, values), expected)
    estimate, confidence = MostProbablePair().with_confidence(logits, values)
    assert_close(estimate, expected)
    assert_close(confidence, mass)
    levels = torch.arange(logits.shape[1], dtype=torch.float64)
    of_levels, _ = loop(logits, levels.reshape(1, -1, 1, 1).expand_as(logits))
    assert_close(most_probable_pair(logits), of_levels)
    assert_close(most_probable_pair(logits, levels), of_levels)


@given(logits(min_levels=2))
def test_where_the_two_largest_are_neighbours_it_is_a_top_2(logits):
    first, second = logits.topk(2, dim=1).indices.unbind(1)
    beside = (first - second).abs() == 1
    assert_close(most_probable_pair(logits)[beside], top_k_soft_argmin(logits, 2)[beside])


@given(logits(min_levels=2, max_levels=2))
def test_of_two_levels_it_is_all(logits):
    assert_close(MostProbablePair().with_confidence(logits)[1], torch.ones_like(logits[:, 0]))
    assert_close(most_probable_pair(logits), top_k_soft_argmin(logits, 2))


def test_gradients_are_right():
    logits = torch.randn(1, 9, 2, 2, dtype=torch.float64, requires_grad=True)
    candidates = torch.randn(1, 9, 2, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(most_probable_pair, (logits, candidates))


@pytest.mark.parametrize("shape", [(3, 4, 5), (1, 1, 4, 5)])
def test_what_makes_no_sense_is_refused(shape):
    with pytest.raises(InputError, match="at least 2"):
        most_probable_pair(torch.rand(shape))
