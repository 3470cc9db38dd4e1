import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import SeparableTrunk
from stereokit.layers import SeparableBlock


def test_features_are_what_the_info_says():
    backbone = SeparableTrunk().eval()
    features = backbone(torch.rand(2, 3, 32, 48))
    shapes = {s: (2, c, 32 // s, 48 // s) for s, c in backbone.info.matching_channels.items()}
    assert {s: tuple(m.shape) for s, m in features.matching.items()} == shapes
    assert {s: tuple(m.shape) for s, m in features.guides.items()} == shapes


def test_it_is_of_the_published_size():
    assert sum(p.numel() for p in SeparableTrunk().parameters()) == 397_648


@pytest.mark.parametrize("activation", [True, False])
def test_the_stem_may_be_plain(activation):
    stem = SeparableTrunk(stem_activation=activation).eval().stem
    assert (stem(torch.randn(1, 3, 16, 16)).min() >= 0) == activation


@pytest.mark.parametrize(("out_channels", "stride"), [(4, 1), (6, 1), (4, 2)])
def test_a_separable_block_is_a_sum(out_channels, stride):
    block = SeparableBlock(4, out_channels, stride=stride).eval()
    x = torch.randn(2, 4, 5, 6)
    given = block(x)
    assert given.shape == (2, out_channels, -(-5 // stride), -(-6 // stride))
    nn.init.zeros_(block.conv2[1][0].weight)
    assert_close(block(x), block.skip(x))
    assert isinstance(block.skip, nn.Identity) == (out_channels == 4 and stride == 1)


def test_only_depthwise_convolutions_see_neighbours():
    convs = [m for m in SeparableBlock(4, 6, dilation=2).modules() if isinstance(m, nn.Conv2d)]
    assert [(c.groups, c.kernel_size[0], c.dilation[0]) for c in convs] == [
        (4, 3, 2),
        (1, 1, 1),
        (6, 3, 2),
        (1, 1, 1),
        (1, 1, 1),
    ]
