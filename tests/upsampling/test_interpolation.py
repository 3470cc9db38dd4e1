import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit.layers import bilinear_upsample
from stereokit.upsampling.interpolation import (
    BilinearUpsampler,
    NoUpsampler,
    TrilinearUpsampler,
    trilinear_upsample,
)
from tests.strategies import disparities, logits

scales = st.integers(1, 4)


def linear(size, scale):
    """Row i: the weights of the coarse samples in fine sample i, whose centre is at (i + 0.5) / scale - 0.5."""
    matrix = torch.zeros(size * scale, size, dtype=torch.float64)
    for i in range(size * scale):
        centre = min(max((i + 0.5) / scale - 0.5, 0), size - 1)
        low = min(int(centre), size - 1)
        high = min(low + 1, size - 1)
        matrix[i, low] += 1 - (centre - low)
        matrix[i, high] += centre - low
    return matrix


@given(disparities(), scales)
def test_bilinear_equals_the_weighted_sum(disparity, scale):
    _, height, width = disparity.shape
    expected = torch.einsum("bhw,yh,xw->byx", disparity, linear(height, scale), linear(width, scale))
    assert_close(bilinear_upsample(disparity, scale), expected)
    assert_close(BilinearUpsampler(scale=scale)(disparity, {}), expected)


@given(logits(max_levels=4), scales)
def test_trilinear_equals_the_weighted_sum(volume, scale):
    _, levels, height, width = volume.shape
    matrices = linear(levels, scale), linear(height, scale), linear(width, scale)
    expected = torch.einsum("bdhw,ed,yh,xw->beyx", volume, *matrices)
    assert_close(trilinear_upsample(volume, scale), expected)
    assert_close(TrilinearUpsampler(scale=scale)(volume, {}), expected)


def test_none_leaves_the_disparity():
    disparity = torch.rand(1, 2, 3)
    assert NoUpsampler()(disparity, {}) is disparity


@pytest.mark.parametrize(
    ("upsampler", "scale", "domain"),
    [
        (BilinearUpsampler(scale=4), 4, "disparity"),
        (TrilinearUpsampler(scale=2), 2, "volume"),
        (NoUpsampler(), 1, "disparity"),
    ],
)
def test_what_they_tell_the_network(upsampler, scale, domain):
    assert upsampler.scale == scale
    assert upsampler.domain == domain
    assert not upsampler.learned
    assert upsampler.guide_channels == {}
    assert not list(upsampler.parameters())


def test_the_scale_is_printed():
    assert repr(BilinearUpsampler(scale=4)) == "BilinearUpsampler(scale=4)"
