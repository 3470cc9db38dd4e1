import pytest
import torch
from hypothesis import given
from torch.testing import assert_close

from stereokit.costs import ConcatenationVolume, concatenation_volume
from stereokit.errors import InputError
from tests.strategies import feature_pairs


@given(feature_pairs())
def test_concatenation_equals_the_loop(pair):
    left, right, levels = pair
    batch, channels, height, width = left.shape
    expected = left.new_zeros(batch, 2 * channels, levels, height, width)
    for d in range(levels):
        for x in range(d, width):
            expected[:, :channels, d, :, x] = left[..., x]
            expected[:, channels:, d, :, x] = right[..., x - d]
    assert_close(concatenation_volume(left, right, levels), expected, rtol=0, atol=0)


def test_levels_beyond_the_width_are_empty():
    volume = concatenation_volume(torch.rand(1, 3, 2, 4), torch.rand(1, 3, 2, 4), 20)
    assert volume.shape == (1, 6, 20, 2, 4)
    assert (volume[:, :, 4:] == 0).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_the_precision_stays(dtype):
    features = torch.rand(1, 2, 2, 4).to(dtype)
    assert concatenation_volume(features, features, 3).dtype == dtype


def test_gradients_are_right():
    left, right = torch.randn(2, 1, 2, 2, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: concatenation_volume(a, b, 3), (left, right))


def test_what_is_no_pair_is_refused():
    with pytest.raises(InputError, match="one shape"):
        concatenation_volume(torch.rand(1, 2, 3, 4), torch.rand(1, 2, 3, 5), 2)


def test_the_module_is_its_function():
    left, right = torch.randn(2, 2, 4, 2, 7)
    module = ConcatenationVolume(in_channels=4, planes=3)
    assert module.out_channels == 8
    assert_close(module(left, right), concatenation_volume(left, right, 3))


def test_the_module_compares_projected_features():
    left, right = torch.randn(2, 2, 4, 2, 7)
    module = ConcatenationVolume(in_channels=4, planes=3, projection=(6, 5)).eval()
    assert module.out_channels == 10
    assert_close(module(left, right), concatenation_volume(*module.projection(left, right), 3))
