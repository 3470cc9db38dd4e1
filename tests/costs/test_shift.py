import pytest
import torch
from hypothesis import given
from torch.testing import assert_close

from stereokit.costs.shift import check_features, inner_products, shifted_stack
from stereokit.errors import InputError
from tests.strategies import feature_pairs


@given(feature_pairs())
def test_inner_products_equal_the_loop(pair):
    left, right, levels = pair
    width = left.shape[-1]
    expected = left.new_zeros(left.shape[0], levels, *left.shape[2:])
    for d in range(levels):
        for x in range(d, width):
            expected[:, d, :, x] = (left[..., x] * right[..., x - d]).sum(1)
    assert_close(inner_products(left, right, levels), expected)


@given(feature_pairs())
def test_shifted_stack_equals_the_loop(pair):
    _, right, levels = pair
    width = right.shape[-1]
    expected = right.new_zeros(*right.shape[:2], levels, *right.shape[2:])
    for d in range(levels):
        for x in range(d, width):
            expected[:, :, d, :, x] = right[..., x - d]
    assert_close(shifted_stack(right, levels), expected, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("left", "right", "levels", "words"),
    [
        ((1, 2, 3, 4), (1, 2, 3, 5), 2, ["(1, 2, 3, 4)", "(1, 2, 3, 5)"]),
        ((2, 3, 4), (2, 3, 4), 2, ["(2, 3, 4)", "(B, C, H, W)"]),
        ((1, 2, 3, 4), (1, 2, 3, 4), 0, ["planes=0", "at least 1"]),
    ],
)
def test_what_is_no_pair_is_refused(left, right, levels, words):
    with pytest.raises(InputError) as error:
        check_features(torch.rand(left), torch.rand(right), levels)
    assert all(word in str(error.value) for word in words)
