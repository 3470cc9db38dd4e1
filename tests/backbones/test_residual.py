import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import ResidualTower
from stereokit.layers import relu
from stereokit.layers.residual import ResidualBlock


def muted(block):
    """The block with its convolutions switched off, so that the skip alone is left."""
    nn.init.zeros_(block.conv2[1].weight)
    return block.eval()


@pytest.mark.parametrize("last_activation", [None, relu])
def test_a_block_adds_to_its_input(last_activation):
    x = torch.randn(1, 4, 6, 6)
    block = ResidualBlock(4, 4, last_activation=last_activation)
    assert isinstance(block.skip, nn.Identity)
    assert_close(muted(block)(x), x)


@pytest.mark.parametrize(("channels", "stride"), [(8, 1), (4, 2), (8, 2)])
def test_a_block_that_changes_shape_projects_its_input(channels, stride):
    x = torch.randn(1, 4, 6, 6)
    block = muted(ResidualBlock(4, channels, stride=stride))
    assert block(x).shape == (1, channels, 6 // stride, 6 // stride)
    assert_close(block(x), block.skip(x))
    assert (block(x) < 0).any()


def test_dilation_keeps_the_size():
    assert ResidualBlock(4, 4, dilation=2)(torch.randn(1, 4, 7, 9)).shape == (1, 4, 7, 9)


def test_features_are_what_the_info_says():
    backbone = ResidualTower(channels=6, blocks=2).eval()
    features = backbone(torch.rand(2, 3, 10, 14))
    assert backbone.multiple == 2
    assert backbone.info.matching_channels[2] == 6
    assert backbone.info.finest == 2
    assert backbone.info.guide_channels == {2: 6}
    assert features.matching[2].shape == (2, 6, 5, 7)
    assert features.guides[2] is features.matching[2]


def test_the_published_depth():
    backbone = ResidualTower()
    assert len(backbone.blocks) == 8
    assert backbone.info.matching_channels[2] == 32


def test_the_last_convolution_is_plain():
    features = ResidualTower(blocks=1)(torch.rand(2, 3, 16, 16)).matching[2]
    assert (features < 0).any()
