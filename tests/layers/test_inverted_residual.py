import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit.layers import InvertedResidual


@pytest.mark.parametrize(("out_channels", "stride", "adds"), [(4, 1, True), (6, 1, False), (4, 2, False)])
def test_the_input_is_added_where_it_fits(out_channels, stride, adds):
    block = InvertedResidual(4, out_channels, stride=stride).eval()
    x = torch.randn(2, 4, 5, 6)
    nn.init.zeros_(block.narrow[0].weight)
    given = block(x)
    assert_close(given, x if adds else torch.zeros_like(given))
    assert given.shape == (2, out_channels, -(-5 // stride), -(-6 // stride))


def test_only_the_depthwise_convolution_sees_neighbours():
    block = InvertedResidual(3, 5, expansion=6).eval()
    assert [
        (c.in_channels, c.out_channels, c.kernel_size[0], c.groups)
        for c in (m[0] for m in (block.widen, block.depthwise, block.narrow))
    ] == [(3, 18, 1, 1), (18, 18, 3, 18), (18, 5, 1, 1)]
    x = torch.zeros(1, 3, 7, 7)
    x[..., 3, 3] = 5
    changed = (block(x) != block(torch.zeros_like(x))).any(1)[0].nonzero()
    assert changed.amin(0).tolist() == [2, 2]
    assert changed.amax(0).tolist() == [4, 4]


def test_what_is_narrowed_is_between_0_and_6():
    block, seen = InvertedResidual(3, 3).eval(), []
    block.narrow.register_forward_hook(lambda _, inputs, __: seen.append(inputs[0]))
    block(100 * torch.randn(1, 3, 6, 6))
    assert seen[0].min() == 0
    assert seen[0].max() == 6


def test_gradients_are_right():
    block = InvertedResidual(2, 2, expansion=2).double().eval()
    x = torch.randn(1, 2, 3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(block, (x,))


def test_volumes_go_through_the_same_block():
    block = InvertedResidual(3, 3, dims=3).eval()
    x = torch.randn(1, 3, 4, 5, 6)
    assert_close(block(x), x + block.narrow(block.depthwise(block.widen(x))))
    plain = InvertedResidual(3, 3, dims=3, residual=False).eval()
    assert_close(plain(x), plain.narrow(plain.depthwise(plain.widen(x))))
