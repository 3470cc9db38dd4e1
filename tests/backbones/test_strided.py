import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.testing import assert_close

from stereokit import ConfigError, StridedTower


@given(st.integers(1, 4), st.integers(1, 3), st.integers(1, 3))
def test_features_are_what_the_info_says(halvings, rows, columns):
    backbone = StridedTower(channels=6, halvings=halvings, blocks=1).eval()
    stride = 2**halvings
    features = backbone(torch.rand(2, 3, rows * stride, columns * stride))
    assert backbone.multiple == stride
    assert backbone.info.matching_channels == backbone.info.guide_channels == {stride: 6}
    assert features.matching[stride].shape == (2, 6, rows, columns)
    assert features.guides[stride] is features.matching[stride]


def test_nothing_stands_between_the_strided_convolutions():
    """Without residual blocks it is one linear map."""
    backbone = StridedTower(channels=4, blocks=0).eval().double()
    one, other = torch.randn(2, 1, 3, 16, 16, dtype=torch.float64)
    nothing = backbone(torch.zeros_like(one)).matching[8]
    parts = [backbone(x).matching[8] - nothing for x in (one, other)]
    assert_close(backbone(one + other).matching[8] - nothing, parts[0] + parts[1])


def test_its_blocks_act_after_the_sum():
    block = StridedTower(channels=4, blocks=1).blocks[0].eval()
    nn.init.zeros_(block.conv2[1].weight)
    x = torch.randn(1, 4, 6, 6)
    assert_close(block(x), torch.where(x < 0, 0.2 * x, x))


def test_no_halving_is_refused():
    with pytest.raises(ConfigError, match="at least 1"):
        StridedTower(halvings=0)
