import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError
from stereokit.costs import SignedCorrelation, groupwise_correlation_volume, signed_correlation
from tests.strategies import feature_pairs


@given(feature_pairs(), st.integers(0, 6))
def test_it_is_the_sum_over_all_pixels(pair, radius):
    left, right, _ = pair
    channels, width = left.shape[1], left.shape[-1]
    naive = torch.zeros(len(left), 2 * radius + 1, *left.shape[-2:], dtype=left.dtype)
    for k in range(2 * radius + 1):
        for x in range(width):
            if 0 <= x + k - radius < width:
                naive[:, k, :, x] = (left[..., x] * right[..., x + k - radius]).sum(1) / channels
    assert_close(signed_correlation(left, right, radius), naive)
    assert_close(SignedCorrelation(radius=radius)(left, right), naive)


@given(feature_pairs(), st.integers(0, 6))
def test_one_side_of_it_is_the_volume_of_mean_products(pair, radius):
    left, right, _ = pair
    volume = groupwise_correlation_volume(left, right, radius + 1, groups=1).squeeze(1)
    assert_close(signed_correlation(left, right, radius)[:, : radius + 1].flip(1), volume)


@given(feature_pairs(), st.integers(0, 6))
def test_views_that_change_places_turn_it_around(pair, radius):
    left, right, _ = pair
    mirrored = signed_correlation(right.flip(-1), left.flip(-1), radius).flip(-1)
    forward = signed_correlation(left, right, radius)
    for k in range(2 * radius + 1):
        shift = k - radius
        if abs(shift) >= left.shape[-1]:
            continue
        low, high = max(0, -shift), min(left.shape[-1], left.shape[-1] - shift)
        # what left at x says of right at x + shift, right says of left
        assert_close(mirrored[:, k, :, low + shift : high + shift], forward[:, k, :, low:high])


def test_gradients_are_right():
    left, right = torch.randn(2, 1, 2, 2, 5, dtype=torch.float64).unbind()
    inputs = [x.clone().requires_grad_() for x in (left, right)]
    assert torch.autograd.gradcheck(lambda a, b: signed_correlation(a, b, 2), inputs)


def test_half_precision_does_not_overflow():
    large = torch.full((1, 64, 1, 4), 200.0, dtype=torch.float16)
    assert signed_correlation(large, large, 1)[0, 1].isfinite().all()


def test_what_is_no_pair_is_refused():
    with pytest.raises(InputError, match="one shape"):
        signed_correlation(torch.rand(1, 2, 3, 4), torch.rand(1, 2, 3, 5), 1)
    with pytest.raises(InputError, match="radius=-1"):
        signed_correlation(*torch.rand(2, 1, 2, 3, 4), -1)
    with pytest.raises(ConfigError, match="radius=-1"):
        SignedCorrelation(radius=-1)
