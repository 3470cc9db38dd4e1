import math

import pytest
import torch
from hypothesis import given
from torch.testing import assert_close

from stereokit import InputError, Mode
from stereokit.regression import mode, top_k_soft_argmin
from tests.strategies import logits, randn, seeds


@given(logits(), seeds)
def test_it_equals_the_loop(logits, seed):
    batch, levels, height, width = logits.shape
    values = randn(seed, batch, levels, height, width, dtype=torch.float64)
    estimate, confidence = Mode().with_confidence(logits, values)
    assert torch.equal(estimate, mode(logits, values))
    whole = mode(logits)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                column = logits[b, :, y, x].tolist()
                best = column.index(max(column))
                assert whole[b, y, x] == best
                assert estimate[b, y, x] == values[b, best, y, x]
                assert math.isclose(confidence[b, y, x], 1 / sum(math.exp(c - max(column)) for c in column))


@given(logits())
def test_it_is_the_top_1(logits):
    candidates = torch.arange(logits.shape[1], dtype=torch.float64) * 2.5
    assert_close(mode(logits, candidates), top_k_soft_argmin(logits, 1, candidates))


def test_the_candidates_are_learned_and_the_logits_are_not():
    logits, candidates = torch.randn(2, 1, 5, 2, 3, requires_grad=True)
    mode(logits, candidates).sum().backward()
    given = torch.autograd.grad(mode(logits.detach(), candidates).sum(), candidates)[0]
    assert torch.equal(given, torch.nn.functional.one_hot(logits.argmax(1), 5).movedim(-1, 1).float())
    assert not mode(logits.requires_grad_()).requires_grad


def test_three_dimensions_are_refused():
    with pytest.raises(InputError, match="logits are"):
        mode(torch.rand(3, 4, 5))
