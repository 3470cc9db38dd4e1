import itertools

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import ConfigError, InputError
from stereokit.layers import (
    AffinityFusion,
    AffinityPooling,
    affinity_fuse,
    affinity_pool,
    affinity_propagate,
    affinity_weights,
)
from tests.strategies import randn, seeds

CENTRES = ["input", "current", "own"]


def neighbors(sides, place):
    """Each neighbour's number in row-major order, and its place; None outside."""
    for j, step in enumerate(itertools.product((-1, 0, 1), repeat=len(sides))):
        there = tuple(p + s for p, s in zip(place, step, strict=True))
        yield j, there if all(0 <= p < side for p, side in zip(there, sides, strict=True)) else None


def loop(x, affinity, steps, signed, centre):
    sides = x.shape[2:]
    middle = 3 ** len(sides) // 2
    affinity = affinity.expand(-1, -1, *sides)
    state = x.clone()
    for _ in range(steps):
        after = torch.zeros_like(x)
        for b, *place in itertools.product(*(range(n) for n in (len(x), *sides))):
            g = affinity[(b, slice(None), *place)].tolist()
            size = sum(map(abs, g)) + 1e-6
            k = [(v if signed else abs(v)) / size for v in g]
            total = torch.zeros(x.shape[1], dtype=x.dtype)
            for j, there in neighbors(sides, place):
                if j == middle and centre != "own":
                    continue
                weight = k[j if centre == "own" or j < middle else j - 1]
                if there is not None:
                    total = total + weight * state[(b, slice(None), *there)]
            if centre != "own":
                total = total + (1 - sum(k)) * (x if centre == "input" else state)[(b, slice(None), *place)]
            after[(b, slice(None), *place)] = total
        state = after
    return state


@st.composite
def maps(draw):
    dims = draw(st.sampled_from([2, 3]))
    shape = draw(st.integers(1, 2)), draw(st.integers(1, 2)), *(draw(st.integers(1, 3)) for _ in range(dims))
    centre = draw(st.sampled_from(CENTRES))
    alike = dims == 3 and draw(st.booleans())
    sides = (1, *shape[3:]) if alike else shape[2:]
    affinity = randn(draw(seeds), shape[0], 3**dims - (centre != "own"), *sides, dtype=torch.float64)
    return randn(draw(seeds), *shape, dtype=torch.float64), affinity, centre


@given(maps(), st.integers(1, 3), st.booleans())
def test_it_equals_the_loop(drawn, steps, signed):
    x, affinity, centre = drawn
    given = affinity_propagate(x, affinity, steps=steps, signed=signed, centre=centre)
    assert_close(given, loop(x, affinity, steps, signed, centre))


@given(maps())
def test_absolute_weights_keep_what_is_inside_between_its_bounds(drawn):
    x, affinity, centre = drawn
    spread = affinity_propagate(x.abs(), affinity, steps=4, signed=False, centre=centre)
    assert (spread >= -1e-12).all()
    assert (spread <= x.abs().max() + 1e-9).all()


@given(maps(), st.floats(-3, 3))
def test_it_is_linear(drawn, factor):
    x, affinity, centre = drawn
    assert_close(
        affinity_propagate(factor * x, affinity, steps=2, centre=centre),
        factor * affinity_propagate(x, affinity, steps=2, centre=centre),
    )


@pytest.mark.parametrize("centre", CENTRES)
@pytest.mark.parametrize("sides", [(3, 2), (2, 2, 3)])
def test_gradients_are_right(centre, sides):
    count = 3 ** len(sides) - (centre != "own")
    x = torch.randn(1, 2, *sides, dtype=torch.float64, requires_grad=True)
    affinity = torch.randn(1, count, *sides, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x, g: affinity_propagate(x, g, steps=3, centre=centre), (x, affinity))
    if len(sides) == 3:
        alike = affinity[:, :, :1].detach().requires_grad_()
        assert torch.autograd.gradcheck(lambda x, g: affinity_propagate(x, g, steps=2, centre=centre), (x, alike))


@given(st.tuples(st.integers(1, 2), st.integers(1, 3), st.integers(1, 9), st.integers(1, 9)), st.integers(1, 5), seeds)
def test_pooling_equals_the_loop(shape, cell, seed):
    batch, _, height, width = shape
    x, g = randn(seed, *shape, dtype=torch.float64), randn(seed + 1, batch, 1, height, width, dtype=torch.float64)
    pooled = affinity_pool(x, g, cell)
    assert pooled.shape[2:] == (-(-height // cell), -(-width // cell))
    for b, c, y, u in itertools.product(*map(range, pooled.shape)):
        rows, columns = slice(y * cell, (y + 1) * cell), slice(u * cell, (u + 1) * cell)
        weight = g[b, 0, rows, columns].abs()
        expected = (weight * x[b, c, rows, columns]).sum() / (weight.sum() + 1e-6)
        assert_close(pooled[b, c, y, u], expected)


def test_equal_weights_pool_as_the_mean_does():
    x = torch.randn(2, 3, 8, 12)
    assert_close(affinity_pool(x, torch.full((2, 1, 8, 12), -0.7), 4), F.avg_pool2d(x, 4))


@given(st.tuples(*4 * [st.integers(1, 3)]), seeds)
def test_fusion_equals_the_loop(shape, seed):
    count, channels, height, width = shape
    branches = randn(seed, 1, count, channels, height, width, dtype=torch.float64)
    affinity = randn(seed + 1, 1, count, 9, height, width, dtype=torch.float64)
    fused = affinity_fuse(branches, affinity)
    for y, x in itertools.product(range(height), range(width)):
        k = affinity[0, :, :, y, x] / (affinity[0, :, :, y, x].abs().sum() + 1e-6)
        expected = torch.zeros(channels, dtype=torch.float64)
        for n, (j, there) in itertools.product(range(count), neighbors((height, width), (y, x))):
            if there is not None:
                expected += k[n, j] * branches[(0, n, slice(None), *there)]
        assert_close(fused[0, :, y, x], expected)


def test_modules_are_their_functions():
    x, g = torch.randn(2, 4, 7, 9), torch.randn(2, 1, 7, 9)
    pooling = AffinityPooling(4, cell=4).eval()
    coarse = pooling.conv(affinity_pool(x, g, 4))
    assert_close(pooling(x, g), F.interpolate(coarse, scale_factor=4, mode="bilinear")[..., :7, :9])
    fusion = AffinityFusion(4, branches=2).eval()
    branches = torch.randn(2, 2, 3, 7, 9)
    assert_close(fusion(branches, x), affinity_fuse(branches, fusion.affinity(x).unflatten(1, (2, 9))))


def test_nothing_is_divided_by_zero():
    assert not affinity_weights(torch.zeros(1, 8, 2, 2)).any()
    assert not affinity_pool(torch.rand(1, 1, 2, 2), torch.zeros(1, 1, 2, 2), 2).any()


def test_what_makes_no_sense_is_refused():
    x = torch.rand(1, 2, 3, 4)
    with pytest.raises(InputError, match=r"wants an affinity \(B, 8"):
        affinity_propagate(x, torch.rand(1, 9, 3, 4), steps=1)
    with pytest.raises(InputError, match="wants an affinity"):
        affinity_propagate(x, torch.rand(1, 8, 3, 5), steps=1)
    with pytest.raises(ConfigError, match="steps=0"):
        affinity_propagate(x, torch.rand(1, 8, 3, 4), steps=0)
    with pytest.raises(ConfigError, match="centre='mine'"):
        affinity_propagate(x, torch.rand(1, 8, 3, 4), steps=1, centre="mine")
    with pytest.raises(InputError, match="fusion of 2 maps"):
        affinity_fuse(torch.rand(1, 2, 1, 3, 4), torch.rand(1, 1, 9, 3, 4))
