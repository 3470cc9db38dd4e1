"""Hypothesis strategies for tensors: hypothesis draws the shape and a seed, the seed gives the values."""

import torch
from hypothesis import strategies as st
from torch import Tensor

seeds = st.integers(0, 2**31 - 1)


def randn(seed: int, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Normal noise that depends on the seed and the shape alone."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@st.composite
def feature_pairs(
    draw: st.DrawFn, *, min_channels: int = 1, dtype: torch.dtype = torch.float64
) -> tuple[Tensor, Tensor, int]:
    """Left and right feature maps (B, C, H, W), and a number of levels that may be larger than W."""
    batch, channels = draw(st.integers(1, 2)), draw(st.integers(min_channels, 6))
    height, width = draw(st.integers(1, 3)), draw(st.integers(1, 9))
    levels = draw(st.integers(1, 12))
    left, right = randn(draw(seeds), 2, batch, channels, height, width, dtype=dtype)
    return left, right, levels


@st.composite
def logits(draw: st.DrawFn, *, min_levels: int = 1, max_levels: int = 9, dtype: torch.dtype = torch.float64) -> Tensor:
    """(B, D, H, W), from nearly flat to sharply peaked."""
    levels = draw(st.integers(min_levels, max_levels))
    shape = (draw(st.integers(1, 2)), levels, draw(st.integers(1, 3)), draw(st.integers(1, 3)))
    return draw(st.sampled_from([0.01, 1, 30])) * randn(draw(seeds), *shape, dtype=dtype)


@st.composite
def disparities(draw: st.DrawFn, *, dtype: torch.dtype = torch.float64) -> Tensor:
    """(B, h, w), from 0 to 40."""
    shape = (draw(st.integers(1, 2)), draw(st.integers(1, 4)), draw(st.integers(1, 5)))
    return 40 * torch.rand(shape, generator=torch.Generator().manual_seed(draw(seeds)), dtype=dtype)
