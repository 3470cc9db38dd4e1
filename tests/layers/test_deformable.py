import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import ConfigError, InputError
from stereokit.layers import Bottleneck, DeformableConvolution, deformable_convolution, sampled_convolution
from tests.strategies import randn, seeds

FORMS = pytest.mark.parametrize("form", [deformable_convolution, sampled_convolution])


def at(image, y, x):
    """A pixel of a map (H, W), 0 outside."""
    inside = 0 <= y < image.shape[0] and 0 <= x < image.shape[1]
    return image[y, x] if inside else image.new_zeros(())


def bilinear(image, y, x):
    y0, x0 = math.floor(y), math.floor(x)
    dy, dx = y - y0, x - x0
    return (
        (1 - dy) * (1 - dx) * at(image, y0, x0)
        + (1 - dy) * dx * at(image, y0, x0 + 1)
        + dy * (1 - dx) * at(image, y0 + 1, x0)
        + dy * dx * at(image, y0 + 1, x0 + 1)
    )


def loop(x, weight, offsets, mask, stride, dilation):
    """Equation 1 of Zhu et al., for a single image."""
    out_channels, channels, kernel, _ = weight.shape
    rows, columns = offsets.shape[-2:]
    groups = mask.shape[1] // kernel**2
    result = x.new_zeros(1, out_channels, rows, columns)
    for i in range(rows):
        for j in range(columns):
            for c in range(channels):
                g = c // (channels // groups)
                for k in range(kernel**2):
                    place = g * kernel**2 + k
                    y = stride * i + dilation * (k // kernel - kernel // 2) + offsets[0, 2 * place, i, j].item()
                    z = stride * j + dilation * (k % kernel - kernel // 2) + offsets[0, 2 * place + 1, i, j].item()
                    value = mask[0, place, i, j] * bilinear(x[0, c], y, z)
                    result[0, :, i, j] += weight[:, c, k // kernel, k % kernel] * value
    return result


@FORMS
@settings(max_examples=15)
@given(st.integers(1, 2), st.integers(1, 2), st.integers(1, 2), st.integers(2, 5), st.integers(2, 6), seeds)
def test_it_is_the_loop(form, groups, stride, dilation, height, width, seed):
    x, weight = (
        randn(seed, *shape, dtype=torch.float64) for shape in ((1, 2 * groups, height, width), (3, 2 * groups, 3, 3))
    )
    rows, columns = -(-height // stride), -(-width // stride)
    offsets = 2 * randn(seed, 1, 18 * groups, rows, columns, dtype=torch.float64)
    mask = randn(seed + 1, 1, 9 * groups, rows, columns, dtype=torch.float64)
    expected = loop(x, weight, offsets, mask, stride, dilation)
    assert_close(form(x, weight, offsets, mask, stride=stride, dilation=dilation), expected)


@given(st.integers(1, 2), st.integers(1, 2), seeds)
def test_both_forms_have_the_same_gradients(stride, dilation, seed):
    shapes = (
        (2, 4, 5, 7),
        (3, 4, 3, 3),
        (2, 36, -(-5 // stride), -(-7 // stride)),
        (2, 18, -(-5 // stride), -(-7 // stride)),
    )
    gradients = []
    for form in (deformable_convolution, sampled_convolution):
        inputs = [randn(seed, *shape, dtype=torch.float64).requires_grad_() for shape in shapes]
        form(*inputs, stride=stride, dilation=dilation).sin().sum().backward()
        gradients.append([x.grad for x in inputs])
    assert_close(*gradients)


@FORMS
def test_half_precision_is_computed_in_single(form):
    x, weight, offsets, mask = (
        torch.rand(1, 2, 4, 5),
        torch.rand(2, 2, 3, 3),
        torch.randn(1, 18, 4, 5),
        torch.rand(1, 9, 4, 5),
    )
    given = form(x.bfloat16(), weight, offsets, mask)
    assert given.dtype == torch.bfloat16
    assert_close(given.float(), form(x.bfloat16().float(), weight, offsets, mask), rtol=0.01, atol=0.01)


@pytest.mark.parametrize("changed", [0, 1, 2, 3])
def test_shapes_that_do_not_fit_are_refused(changed):
    shapes = [(1, 4, 6, 8), (2, 4, 3, 3), (1, 18, 6, 8), (1, 9, 6, 8)]
    deformable_convolution(*(torch.rand(shape) for shape in shapes))
    shapes[changed] = (1, 5, 5, 8)
    with pytest.raises(InputError, match="a deformable convolution wants"):
        deformable_convolution(*(torch.rand(shape) for shape in shapes))


@given(st.integers(1, 2), st.integers(3, 7), st.integers(3, 7), seeds)
def test_it_begins_as_an_ordinary_convolution(stride, height, width, seed):
    block = DeformableConvolution(4, 3, stride=stride).double()
    x = randn(seed, 2, 4, height, width, dtype=torch.float64)
    assert_close(block(x), F.conv2d(x, block.weight, stride=stride, padding=2, dilation=2))


def test_what_tells_it_where_is_trained():
    block = DeformableConvolution(4, 3)
    nn.init.normal_(block.places.weight)
    block(torch.rand(1, 4, 5, 6)).sum().backward()
    assert all(p.grad.abs().max() > 0 for p in block.parameters())


def test_groups_that_do_not_fit_are_refused():
    with pytest.raises(ConfigError, match="groups=2 do not divide the 3 channels"):
        DeformableConvolution(3, 4)


def test_it_is_exported_as_operators_that_runtimes_have():
    block = DeformableConvolution(4, 3).eval()
    nn.init.normal_(block.places.weight)
    x = torch.rand(1, 4, 9, 12)
    program = torch.export.export(block, (x,))
    assert not any("torchvision" in str(node.target) for node in program.graph.nodes)
    assert_close(program.module()(x), block(x), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("deformable", [True, False])
def test_a_bottleneck_adds_its_input(deformable):
    block = Bottleneck(8, 4, 8, deformable=deformable).eval()
    nn.init.zeros_(block.conv3[1].weight)
    x = torch.randn(1, 8, 5, 6)
    assert_close(block(x), x.relu())
    assert any(isinstance(m, DeformableConvolution) for m in block.modules()) == deformable
