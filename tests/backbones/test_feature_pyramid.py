import pytest
import torch
from torch.testing import assert_close

from stereokit import FeaturePyramid
from tests.backbones.test_encoder import ENCODERS


@pytest.mark.parametrize("encoder", ENCODERS)
def test_features_are_what_the_info_says(encoder):
    backbone = FeaturePyramid(encoder=encoder).eval()
    features = backbone(torch.rand(2, 3, 64, 96))
    assert backbone.info.guide_channels == backbone.encoder.channels
    assert {s: tuple(g.shape) for s, g in features.guides.items()} == {
        s: (2, c, 64 // s, 96 // s) for s, c in backbone.encoder.channels.items()
    }
    assert list(features.matching) == [4]
    assert features.matching[4] is features.guides[4]


def test_each_matching_channel_has_mean_0_and_variance_1_in_each_image():
    x = FeaturePyramid().eval()(torch.rand(2, 3, 64, 96)).matching[4]
    assert_close(x.mean((2, 3)), torch.zeros(2, 24), atol=1e-5, rtol=0)
    assert_close(x.var((2, 3), correction=0), torch.ones(2, 24), atol=1e-3, rtol=0)


def test_images_of_a_batch_do_not_meet():
    backbone = FeaturePyramid().eval().double()
    images = torch.rand(2, 3, 64, 96, dtype=torch.float64)
    assert_close(backbone(images).matching[4][1:], backbone(images[1:]).matching[4])


def test_every_weight_takes_part():
    backbone = FeaturePyramid()
    features = backbone(torch.rand(2, 3, 64, 96))
    sum(g[:, :, 1:].square().sum() for g in features.guides.values()).backward()
    assert [name for name, p in backbone.named_parameters() if p.grad is None] == []
