import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.testing import assert_close

from stereokit.optimize import convolution
from stereokit.optimize.convolution import (
    FusedConvolution,
    fold_batch_norm,
    fusable_activation,
    is_plain_convolution,
    subpixel_weight,
)
from stereokit.runtime.processor import compiles_transposed
from tests.strategies import randn, seeds

ACTIVATIONS = [None, nn.ReLU(), nn.LeakyReLU(0.2), nn.ReLU6(), nn.Hardtanh(-0.5, 2), nn.SiLU(), nn.Hardswish()]


@st.composite
def convolutions(draw):
    """A convolution of any kind with random weights, in double precision, and its number of dimensions."""
    dims, transposed = draw(st.sampled_from([2, 3])), draw(st.booleans())
    groups = draw(st.sampled_from([1, 2]))
    channels = [groups * draw(st.integers(1, 3)) for _ in range(2)]
    kernel, stride = draw(st.sampled_from([1, 3, 4])), draw(st.integers(1, 2))
    padding = draw(st.integers(0, kernel // 2))
    kind = {(2, False): nn.Conv2d, (3, False): nn.Conv3d, (2, True): nn.ConvTranspose2d, (3, True): nn.ConvTranspose3d}
    extra = {"output_padding": draw(st.integers(0, stride - 1))} if transposed else {}
    conv = kind[dims, transposed](
        *channels, kernel, stride=stride, padding=padding, groups=groups, bias=draw(st.booleans()), **extra
    )
    return conv, dims


def random_norm(channels, dims, seed, *, affine=True):
    norm = (nn.BatchNorm2d if dims == 2 else nn.BatchNorm3d)(channels, affine=affine).eval()
    for i, tensor in enumerate((norm.running_mean, norm.weight, norm.bias)):
        if tensor is not None:
            tensor.data.copy_(randn(seed + i, channels))
    norm.running_var.copy_(randn(seed + 3, channels).exp())
    return norm


@given(convolutions(), seeds, st.booleans(), st.sampled_from(ACTIVATIONS))
def test_one_layer_does_what_three_did(made, seed, affine, activation):
    conv, dims = made
    norm = random_norm(conv.out_channels, dims, seed, affine=affine)
    x = randn(seed, 2, conv.in_channels, *[5, 4, 6][:dims])
    for dtype, accuracy in ((torch.float64, 1e-9), (torch.float32, 1e-4)):
        conv, norm, x = conv.to(dtype), norm.to(dtype), x.to(dtype)
        fused = FusedConvolution(conv, norm, activation and fusable_activation(activation))
        with torch.no_grad():
            expected = norm(conv(x))
            expected = expected if activation is None else activation(expected)
            assert_close(fused(x), expected, rtol=accuracy, atol=accuracy)


@given(convolutions(), seeds)
def test_without_a_norm_it_is_the_convolution(made, seed):
    conv, dims = made
    x = randn(seed, 1, conv.in_channels, *[5, 4, 6][:dims])
    with torch.no_grad():
        assert_close(FusedConvolution(conv)(x), conv(x), rtol=1e-4, atol=1e-4)


@given(convolutions(), seeds)
def test_folding_keeps_the_convolution(made, seed):
    conv, dims = made
    before = conv.weight.detach().clone()
    weight, bias = fold_batch_norm(conv, random_norm(conv.out_channels, dims, seed))
    assert weight.shape == conv.weight.shape
    assert bias.shape == (conv.out_channels,)
    assert not weight.requires_grad
    assert torch.equal(conv.weight, before)


@pytest.mark.parametrize("kernel", [3, 4])
@pytest.mark.parametrize("dims", [2, 3])
@pytest.mark.parametrize("channels", [1, 3, 9])
def test_narrow_doublings_are_convolutions_by_parity(kernel, dims, channels):
    kind = nn.ConvTranspose2d if dims == 2 else nn.ConvTranspose3d
    conv = kind(4, channels, kernel, stride=2, padding=1, output_padding=kernel % 2)
    fused = FusedConvolution(conv, None, fusable_activation(nn.ReLU()))
    assert fused.subpixel
    assert fused.weight.shape == (2**dims * channels, 4, *[2] * dims)
    x = randn(kernel, 2, 4, *[3, 1, 5][:dims])
    with torch.no_grad():
        assert_close(fused(x), conv(x).relu(), rtol=1e-5, atol=1e-5)


@given(st.integers(1, 4), st.integers(1, 3), seeds)
def test_subpixel_weights_are_all_weights_once(channels, outputs, seed):
    weight = randn(seed, channels, outputs, 4, 4)
    assert_close(subpixel_weight(weight).flatten().sort().values, weight.flatten().sort().values)


@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("padding", [0, 1, 2])
@pytest.mark.parametrize("stride", [1, (1, 2, 2)])
def test_volumes_to_one_channel_are_summed_over_slices(bias, padding, stride):
    conv = nn.Conv3d(5, 1, 3, stride=stride, padding=padding, bias=bias)
    fused = FusedConvolution(conv, random_norm(1, 3, 0), fusable_activation(nn.LeakyReLU(0.1)))
    assert fused.by_slices
    x = randn(0, 2, 5, 4, 6, 7)
    with torch.no_grad():
        expected = nn.functional.leaky_relu(random_norm(1, 3, 0)(conv(x)), 0.1)
        assert_close(fused(x), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    "module", [nn.Softmax(1), nn.PReLU(), nn.GELU(), nn.Dropout(), type("Mine", (nn.ReLU,), {})(), nn.Conv2d(1, 1, 1)]
)
def test_other_activations_are_not_fused(module):
    assert fusable_activation(module) is None


@pytest.mark.parametrize(
    ("module", "plain"),
    [
        (nn.Conv2d(1, 1, 3), True),
        (nn.ConvTranspose3d(1, 1, 3), True),
        (nn.Conv2d(1, 1, 3, padding_mode="reflect", padding=1), False),
        (nn.Conv2d(1, 1, 3, padding="same"), False),
        (nn.Conv1d(1, 1, 3), False),
        (nn.utils.parametrizations.weight_norm(nn.Conv2d(1, 1, 3)), False),
        (type("Mine", (nn.Conv2d,), {})(1, 1, 3), False),
    ],
)
def test_only_convolutions_as_they_come_are_plain(module, plain):
    assert is_plain_convolution(module) is plain


def test_single_precision_weights_take_other_images():
    fused = FusedConvolution(nn.Conv2d(2, 3, 3).bfloat16())
    assert fused(torch.rand(1, 2, 5, 5)).dtype == torch.bfloat16


@pytest.mark.parametrize("told", [compiles_transposed(), False])
@pytest.mark.parametrize("dims", [2, 3])
def test_transposed_convolutions_have_their_size_in_a_compiled_network(dims, told, monkeypatch):
    monkeypatch.setattr(convolution, "compiles_transposed", lambda: told)
    up, after = ((nn.ConvTranspose2d, nn.Conv2d), (nn.ConvTranspose3d, nn.Conv3d))[dims - 2]
    plain = nn.Sequential(up(16, 24, 4, stride=2, padding=1), nn.ReLU(), after(24, 12, 3))
    fused = nn.Sequential(
        FusedConvolution(plain[0], activation=fusable_activation(nn.ReLU())), FusedConvolution(plain[2])
    )
    x = torch.randn(1, 16, *[3] * dims)
    with torch.inference_mode():
        assert_close(torch.compile(fused, backend="eager")(x), plain(x))
