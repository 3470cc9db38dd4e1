import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit.layers import UpStep


@given(st.integers(1, 5), st.integers(1, 5), st.booleans())
def test_any_skip_that_halves_to_the_coarse_map_fits(height, width, odd):
    step = UpStep(3, 2, 5).eval()
    skip = torch.rand(1, 2, 2 * height - odd, 2 * width - odd)
    assert step(torch.rand(1, 3, height, width), skip).shape == (1, 5, *skip.shape[-2:])


@pytest.mark.parametrize("skip_first", [True, False])
def test_the_skip_stands_where_it_is_told(skip_first):
    step = UpStep(3, 2, 5, skip_first=skip_first).eval()
    x, skip = torch.rand(1, 3, 2, 3), torch.rand(1, 2, 4, 6)
    parts = (skip, step.up(x)) if skip_first else (step.up(x), skip)
    assert_close(step(x, skip), step.merge(torch.cat(parts, 1)))
