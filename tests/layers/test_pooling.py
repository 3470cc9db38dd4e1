import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import InputError
from stereokit.layers import cell_means, tent_means

sides = st.integers(2, 12)


@st.composite
def shrunk(draw):
    height, width = draw(sides), draw(sides)
    return height, width, draw(st.integers(2, height)), draw(st.integers(2, width)), draw(st.integers(0, 2**31))


def tent_loop(x: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """The equation, pixel by pixel."""
    result = torch.zeros(*x.shape[:2], height, width, dtype=x.dtype)
    step_y, step_x = (x.shape[-2] - 1) / (height - 1), (x.shape[-1] - 1) / (width - 1)
    for i in range(height):
        for j in range(width):
            total = 0.0
            for k in range(x.shape[-2]):
                for n in range(x.shape[-1]):
                    weight = max(0.0, 1 - abs(k - i * step_y) / step_y) * max(0.0, 1 - abs(n - j * step_x) / step_x)
                    result[..., i, j] += weight * x[..., k, n]
                    total += weight
            result[..., i, j] /= total
    return result


@given(shrunk())
def test_tent_means_are_those_of_the_loop(case):
    height, width, h, w, seed = case
    x = torch.rand(2, 1, height, width, generator=torch.Generator().manual_seed(seed))
    assert_close(tent_means(x, h, w), tent_loop(x.double(), h, w).float(), rtol=1e-4, atol=1e-5)


@given(shrunk())
def test_tent_means_keep_what_is_constant_and_stay_within_bounds(case):
    height, width, h, w, seed = case
    x = torch.rand(1, 2, height, width, generator=torch.Generator().manual_seed(seed))
    means = tent_means(x, h, w)
    assert means.shape == (1, 2, h, w)
    assert means.min() >= x.min() - 1e-6
    assert means.max() <= x.max() + 1e-6
    assert_close(tent_means(torch.full_like(x, 7.0), h, w), torch.full((1, 2, h, w), 7.0))


def test_tent_means_of_the_same_size_change_nothing():
    x = torch.rand(1, 1, 5, 9)
    assert_close(tent_means(x, 5, 9), x)


@pytest.mark.parametrize(("height", "width"), [(1, 3), (3, 1), (6, 3), (3, 10)])
def test_tent_means_are_smaller(height, width):
    with pytest.raises(InputError, match="sides from 2"):
        tent_means(torch.rand(1, 1, 5, 9), height, width)


@given(st.integers(1, 17), st.integers(1, 17), st.integers(1, 7), st.integers(0, 2**31))
def test_cell_means_are_those_of_adaptive_pooling(height, width, cells, seed):
    x = torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(seed))
    assert_close(cell_means(x, cells), F.adaptive_avg_pool2d(x, cells))
