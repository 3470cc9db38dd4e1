import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError
from stereokit.costs import WarpedCorrelation, signed_correlation, warped_correlation
from tests.strategies import feature_pairs, seeds


def between(row, place):
    """A row (C, W) at a place between two columns."""
    first = min(max(math.floor(place), 0), row.shape[1] - 1)
    after = min(first + 1, row.shape[1] - 1)
    return row[:, first] + (place - first) * (row[:, after] - row[:, first])


def loop(left, right, disparity, radius):
    batch, channels, height, width = left.shape
    result = torch.zeros(batch, 2 * radius + 1, height, width, dtype=left.dtype)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                for k in range(2 * radius + 1):
                    beside = x + k - radius
                    if not 0 <= beside < width:
                        continue
                    place = beside - disparity[b, y, beside].item()
                    if 0 <= place <= width - 1:
                        result[b, k, y, x] = left[b, :, y, x] @ between(right[b, :, y], place) / channels
    return result


@given(feature_pairs(), st.integers(0, 2), seeds)
def test_it_equals_the_loop(pair, radius, seed):
    left, right, _ = pair
    generator = torch.Generator().manual_seed(seed)
    disparity = 8 * torch.rand(left[:, 0].shape, generator=generator, dtype=left.dtype) - 2
    expected = loop(left, right, disparity, radius)
    assert_close(warped_correlation(left, right, disparity, radius), expected)
    assert_close(WarpedCorrelation(radius=radius)(left, right, disparity), expected)


@given(feature_pairs(), st.integers(0, 3))
def test_without_a_disparity_nothing_is_warped(pair, radius):
    left, right, _ = pair
    expected = signed_correlation(left, right, radius)
    assert_close(warped_correlation(left, right, torch.zeros_like(left[:, 0]), radius), expected)
    assert_close(WarpedCorrelation(radius=radius)(left, right, None), expected)


def test_the_right_disparity_leaves_the_middle():
    scene = torch.randn(1, 64, 3, 30)
    left, right = scene[..., :24], scene[..., 4:28]
    found = warped_correlation(left, right, torch.full((1, 3, 24), 4.0), 3).argmax(1)
    assert (found[..., 8:-4] == 3).all()
    # one less than it is lies to the left
    assert (warped_correlation(left, right, torch.full((1, 3, 24), 3.0), 3).argmax(1)[..., 8:-4] == 2).all()


def test_gradients_are_right():
    left, right = torch.randn(2, 1, 2, 2, 5, dtype=torch.float64).unbind()
    # between two columns and inside, where there is a gradient
    disparity = torch.full((1, 2, 5), 0.3, dtype=torch.float64)
    inputs = [x.clone().requires_grad_() for x in (left, right, disparity)]
    assert torch.autograd.gradcheck(lambda a, b, d: warped_correlation(a, b, d, 1), inputs)


def test_what_is_no_pair_is_refused():
    with pytest.raises(InputError, match="of the size of the maps"):
        warped_correlation(*torch.rand(2, 1, 2, 3, 4), torch.rand(1, 3, 5), 1)
    with pytest.raises(ConfigError, match="radius=-1"):
        WarpedCorrelation(radius=-1)
