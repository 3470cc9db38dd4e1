import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.testing import assert_close

from stereokit import MSCA, ConfigError, InputError
from tests.strategies import randn, seeds


@st.composite
def volumes_and_guides(draw):
    size = draw(st.integers(1, 2)), draw(st.integers(1, 4)), draw(st.integers(1, 6)), draw(st.integers(1, 6))
    batch, planes, height, width = size
    volume = randn(draw(seeds), batch, 3, planes, height, width, dtype=torch.float64)
    return volume, randn(draw(seeds), batch, 5, height, width, dtype=torch.float64)


@given(volumes_and_guides())
def test_the_factor_is_the_same_at_every_disparity(drawn):
    volume, guide = drawn
    block = MSCA(5, 3).double()
    factors = block(torch.ones_like(volume), guide)
    assert_close(factors, block.factors(guide).unsqueeze(2).expand_as(volume))
    assert_close(block(volume, guide), factors * volume)


@given(volumes_and_guides())
def test_it_is_linear_in_the_volume(drawn):
    volume, guide = drawn
    block = MSCA(5, 3).double()
    assert_close(block(2.5 * volume, guide), 2.5 * block(volume, guide))


@given(volumes_and_guides(), st.sampled_from([(1,), (3, 5), (7, 11, 21)]))
def test_factors_equal_the_loop(drawn, lengths):
    _, guide = drawn
    block = MSCA(5, 3, lengths=lengths).double()
    a = torch.einsum("cg,bghw->bchw", block.project.weight[..., 0, 0], guide) + block.project.bias[:, None, None]
    total = a.clone()
    for n, (along, down) in zip(lengths, block.strips, strict=True):
        rows = torch.zeros_like(a)
        for x in range(a.shape[-1]):
            for j in range(n):
                if 0 <= x + j - n // 2 < a.shape[-1]:
                    rows[..., x] += along.weight[:, 0, 0, j, None] * a[..., x + j - n // 2]
        rows += along.bias[:, None, None]
        for y in range(a.shape[-2]):
            for j in range(n):
                if 0 <= y + j - n // 2 < a.shape[-2]:
                    total[..., y, :] += down.weight[:, 0, j, 0, None] * rows[..., y + j - n // 2, :]
        total += down.bias[:, None, None]
    expected = torch.einsum("cd,bdhw->bchw", block.mix.weight[..., 0, 0], total) + block.mix.bias[:, None, None]
    assert_close(block.factors(guide), expected)


def test_a_strip_reaches_as_far_as_it_is_long():
    block = MSCA(1, 1, lengths=(3, 9))
    guide = torch.zeros(1, 1, 15, 15)
    base = block.factors(guide)
    guide[..., 7, 7] = 1
    changed = ((block.factors(guide) - base).abs() > 1e-7)[0, 0].nonzero()
    assert changed.amin(0).tolist() == [3, 3]
    assert changed.amax(0).tolist() == [11, 11]


def test_gradients_are_right():
    block = MSCA(3, 2, lengths=(3, 5)).double()
    volume = torch.randn(2, 2, 2, 2, 3, dtype=torch.float64, requires_grad=True)
    guide = torch.randn(2, 3, 2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(block, (volume, guide))


def test_each_strip_keeps_to_its_channel():
    strips = [m for m in MSCA(5, 4).strips.modules() if isinstance(m, nn.Conv2d)]
    assert [m.kernel_size for m in strips] == [(1, 7), (7, 1), (1, 11), (11, 1), (1, 21), (21, 1)]
    assert {m.groups for m in strips} == {4}


def test_a_fresh_block_keeps_the_volume_in_its_range():
    factors = MSCA(24, 48).factors(torch.randn(1, 24, 32, 32))
    assert factors.std() < 1


@pytest.mark.parametrize("lengths", [(7, 8), (0,), (-3,)])
def test_even_strips_are_refused(lengths):
    with pytest.raises(ConfigError, match="a strip has a centre; use odd lengths"):
        MSCA(5, 3, lengths=lengths)


def test_a_guide_of_another_width_is_refused():
    with pytest.raises(InputError, match="wants a volume"):
        MSCA(5, 3)(torch.rand(1, 3, 2, 4, 4), torch.rand(1, 6, 4, 4))
