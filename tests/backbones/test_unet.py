import pytest
import torch
from torch.testing import assert_close

from stereokit import ConfigError, UNet
from tests.backbones.test_encoder import ENCODERS


@pytest.mark.parametrize("encoder", ENCODERS)
def test_features_are_what_the_info_says(encoder):
    backbone = UNet(encoder=encoder).eval()
    info = backbone.info
    features = backbone(torch.rand(2, 3, 64, 96))
    assert info.finest == 4
    assert features.matching[4].shape == (2, info.matching_channels[4], 16, 24)
    assert {s: tuple(g.shape) for s, g in features.guides.items()} == {
        s: (2, c, 64 // s, 96 // s) for s, c in info.guide_channels.items()
    }
    assert list(features.guides) == [2, 4, 8, 16, 32]
    assert backbone.multiple == 32


def test_channels_are_those_of_coex():
    info = UNet().info
    assert info.matching_channels[4] == 96
    assert info.guide_channels == {2: 32, 4: 96, 8: 64, 16: 192, 32: 160}


def test_the_stem_is_part_of_the_matching_features():
    backbone = UNet(stem_channels=(6, 10)).eval()
    assert backbone.info.guide_channels[2] == 6
    assert backbone.info.matching_channels[4] == 48 + 10
    images = torch.rand(1, 3, 64, 96)
    features = backbone(images)
    stem_2 = backbone.stem_2(images)
    assert_close(features.guides[2], stem_2)
    assert_close(features.matching[4][:, 48:], backbone.stem_4(stem_2))
    assert_close(features.matching[4], features.guides[4])


def test_every_weight_takes_part():
    backbone = UNet()
    features = backbone(torch.rand(2, 3, 64, 96))
    sum(g.square().sum() for g in features.guides.values()).backward()
    assert [name for name, p in backbone.named_parameters() if p.grad is None] == []


def test_images_of_a_batch_do_not_meet():
    backbone = UNet().eval().double()
    images = torch.rand(2, 3, 64, 96, dtype=torch.float64)
    assert_close(backbone(images).matching[4][1:], backbone(images[1:]).matching[4])


def test_a_third_stem_goes_on_to_stride_8():
    backbone = UNet(stem_channels=(6, 10, 7)).eval()
    assert backbone.info.matching_channels == {4: 48 + 10, 8: 64 + 7}
    assert backbone.info.guide_channels[8] == 64 + 7
    assert backbone.info.finest == 4
    images = torch.rand(1, 3, 64, 96)
    features = backbone(images)
    stem_4 = backbone.stem_4(backbone.stem_2(images))
    assert_close(features.matching[8][:, 64:], backbone.stem_8(stem_4))
    assert features.matching[8] is features.guides[8]


def test_other_numbers_of_stems_are_refused():
    with pytest.raises(ConfigError, match="give two"):
        UNet(stem_channels=(6,))
