import torch
from torch import nn
from torch.testing import assert_close

from stereokit import Embedding
from stereokit.layers import ActNormResidual, conv_act_norm


def test_features_are_what_the_info_says():
    backbone = Embedding(channels=6)
    features = backbone(torch.rand(2, 3, 32, 48))
    assert backbone.info.matching_channels == backbone.info.guide_channels == {4: 6}
    assert features.matching[4].shape == (2, 6, 8, 12)
    assert features.guides[4] is features.matching[4]


def test_it_is_of_the_published_size():
    shortcut = sum(p.numel() for p in conv_act_norm(64, 8).parameters())
    assert sum(p.numel() for p in Embedding().parameters()) + shortcut == 260_440


def test_each_image_is_normalised_by_itself_in_both_modes():
    backbone = Embedding(channels=4).double()
    images = torch.rand(2, 3, 16, 16, dtype=torch.float64)
    both = backbone(images).matching[4]
    assert_close(both[:1], backbone(images[:1]).matching[4])
    assert_close(backbone.eval()(images).matching[4], both)


def test_the_norm_follows_the_activation():
    layer = conv_act_norm(3, 4)
    assert [type(m) for m in layer] == [nn.Conv2d, nn.LeakyReLU, nn.InstanceNorm2d]
    assert layer[0].bias is not None
    assert layer[1].negative_slope == 0.1
    assert layer[2].affine
    assert not layer[2].track_running_stats


def test_a_residual_adds_its_input():
    block, x = ActNormResidual(3), torch.randn(1, 3, 4, 5)
    assert_close(block(x), x + block.conv2(block.conv1(x)))
