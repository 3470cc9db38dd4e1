import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.testing import assert_close

from stereokit.layers import ConvNormAct, at_least_float32, crop_to, init_convolutions, relu


@given(st.integers(1, 20), st.integers(1, 20), st.sampled_from([1, 3, 5]), st.integers(1, 2), st.integers(1, 3))
def test_stride_divides_the_size_rounding_up(height, width, kernel, stride, dilation):
    layer = ConvNormAct(2, 3, kernel, stride=stride, dilation=dilation).eval()
    expected = (1, 3, math.ceil(height / stride), math.ceil(width / stride))
    assert layer(torch.rand(1, 2, height, width)).shape == expected


@pytest.mark.parametrize("kernel", [3, 4])
@pytest.mark.parametrize("dims", [2, 3])
def test_transposed_doubles_the_size(kernel, dims):
    size = (5, 6, 7)[:dims]
    layer = ConvNormAct(2, 3, kernel, dims=dims, stride=2, transposed=True)
    assert layer(torch.rand(2, 2, *size)).shape == (2, 3, *(2 * side for side in size))


@pytest.mark.parametrize(("dims", "conv", "norm"), [(2, nn.Conv2d, nn.BatchNorm2d), (3, nn.Conv3d, nn.BatchNorm3d)])
def test_a_layer_is_convolution_norm_and_activation(dims, conv, norm):
    layer = ConvNormAct(2, 3, dims=dims)
    assert [type(m) for m in layer] == [conv, norm, nn.LeakyReLU]
    assert layer[0].bias is None
    assert layer[2].negative_slope == 0.01
    assert isinstance(ConvNormAct(2, 3, dims=dims, activation=relu)[2], nn.ReLU)
    assert len(ConvNormAct(2, 3, dims=dims, activation=None)) == 2


@given(st.lists(st.integers(1, 6), min_size=2, max_size=3), st.integers(0, 2))
def test_crop_keeps_the_corner_at_the_origin(size, extra):
    x = torch.rand(2, 3, *(side + extra for side in size))
    cropped = crop_to(x, torch.empty(1, 7, *size))
    assert_close(cropped, x[(..., *(slice(side) for side in size))])


@pytest.mark.parametrize(
    ("layer", "fan_out"),
    [
        (nn.Conv2d(40, 60, 3), 9 * 60),
        (nn.Conv3d(20, 30, 3), 27 * 30),
        (nn.ConvTranspose2d(40, 60, 4), 16 * 60),
        (nn.ConvTranspose3d(20, 30, 4), 64 * 30),
    ],
)
def test_weights_have_the_published_spread(layer, fan_out):
    init_convolutions(nn.Sequential(layer))
    assert layer.weight.std().item() == pytest.approx(math.sqrt(2 / fan_out), rel=0.03)
    assert abs(layer.weight.mean().item()) < 0.01
    assert (layer.bias == 0).all()


def test_other_layers_keep_their_weights():
    linear = nn.Linear(3, 4)
    before = linear.weight.clone()
    init_convolutions(linear)
    assert_close(linear.weight, before)


@pytest.mark.parametrize(
    ("given_dtype", "dtype"),
    [
        (torch.float16, torch.float32),
        (torch.bfloat16, torch.float32),
        (torch.float32, torch.float32),
        (torch.float64, torch.float64),
    ],
)
def test_precision_is_at_least_single(given_dtype, dtype):
    assert at_least_float32(torch.ones(1, dtype=given_dtype)).dtype == dtype
