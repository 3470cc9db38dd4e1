import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError, SubPixelMap
from stereokit.regression import soft_argmin, sub_pixel_map
from tests.strategies import logits, seeds


def loop(logits, values, radius):
    """Pixel by pixel; the estimate, and the share of the probability."""
    batch, levels, height, width = logits.shape
    estimate, mass = torch.empty(2, batch, height, width, dtype=logits.dtype)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                column = [v.item() for v in logits[b, :, y, x]]
                peak = column.index(max(column))
                near = range(max(peak - radius, 0), min(peak + radius, levels - 1) + 1)
                weight = {d: math.exp(column[d] - column[peak]) for d in range(levels)}
                total = sum(weight[d] for d in near)
                estimate[b, y, x] = sum(weight[d] * values[b, d, y, x].item() for d in near) / total
                mass[b, y, x] = total / sum(weight.values())
    return estimate, mass


@given(logits(), st.integers(0, 4), seeds)
def test_it_equals_the_loop(logits, radius, seed):
    values = torch.rand(logits.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    expected, mass = loop(logits, values, radius)
    assert_close(sub_pixel_map(logits, values, radius=radius), expected)
    estimate, confidence = SubPixelMap(radius=radius).with_confidence(logits, values)
    assert_close(estimate, expected)
    assert_close(confidence, mass)
    levels = torch.arange(logits.shape[1], dtype=torch.float64)
    of_levels, _ = loop(logits, levels.reshape(1, -1, 1, 1).expand_as(logits), radius)
    assert_close(sub_pixel_map(logits, radius=radius), of_levels)
    assert_close(sub_pixel_map(logits, levels, radius=radius), of_levels)


@given(logits())
def test_a_wide_window_is_a_soft_argmin(logits):
    assert_close(sub_pixel_map(logits, radius=logits.shape[1]), soft_argmin(logits))


@given(logits())
def test_a_window_of_one_is_the_largest(logits):
    assert torch.equal(sub_pixel_map(logits, radius=0), logits.argmax(1).to(logits.dtype))


def test_gradients_are_right():
    logits = torch.randn(1, 9, 2, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(sub_pixel_map, (logits,))


def test_what_makes_no_sense_is_refused():
    with pytest.raises(InputError, match="logits are"):
        sub_pixel_map(torch.rand(3, 4, 5))
    for radius in (-1, 1.5, True):
        with pytest.raises(ConfigError, match="whole number of levels"):
            SubPixelMap(radius=radius)
