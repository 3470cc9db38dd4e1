import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError
from stereokit.upsampling import ConvexUpsampler, ConvexWeights
from tests.strategies import seeds


@given(seeds, st.sampled_from([2, 4]))
def test_weights_are_laid_out_neighbor_by_neighbor_row_by_row(seed, scale):
    torch.manual_seed(seed)
    block = ConvexWeights(3, scale, channels=4)
    x = torch.randn(2, 3, 2, 3)
    logits = 0.25 * block.layers(x)
    weights = block(x)
    assert_close(weights.sum(1), torch.ones(2, 2 * scale, 3 * scale))
    for y in range(2 * scale):
        for x_ in range(3 * scale):
            cell = logits[:, :, y // scale, x_ // scale].reshape(2, 9, scale, scale)
            assert_close(weights[:, :, y, x_], cell[:, :, y % scale, x_ % scale].softmax(1))


@given(seeds)
def test_a_disparity_stays_within_its_neighbors(seed):
    torch.manual_seed(seed)
    upsampler = ConvexUpsampler(scale=4, guide_channels={4: 3}, channels=8)
    disparity = torch.rand(1, 3, 5)
    fine = upsampler(disparity, {4: torch.randn(1, 3, 3, 5)})
    assert fine.shape == (1, 12, 20)
    assert fine.min() >= disparity.min() - 1e-6
    assert fine.max() <= disparity.max() + 1e-6
    flat = torch.full_like(disparity, 7.0)
    assert_close(upsampler(flat, {4: torch.randn(1, 3, 3, 5)}), torch.full((1, 12, 20), 7.0))


def test_a_guide_of_the_disparitys_stride_is_needed():
    with pytest.raises(ConfigError, match="stride 4"):
        ConvexUpsampler(scale=4, guide_channels={2: 3})
