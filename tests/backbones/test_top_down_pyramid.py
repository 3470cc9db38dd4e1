import pytest
import torch
from torch import nn
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import ConfigError, TopDownPyramid

DEEP = {"name": "gwc_trunk", "full_size": True}


@pytest.mark.parametrize(
    ("base", "finest", "matching"),
    [
        ("spatial_pyramid", 2, {4: 32, 2: 16}),
        ({"name": "spatial_pyramid", "full_size": True}, 1, {4: 32, 2: 16, 1: 8}),
        (DEEP, 1, {4: 320, 2: 160, 1: 80}),
        ("unet", 2, {4: 96, 2: 48}),
    ],
)
def test_features_are_what_the_info_says(base, finest, matching):
    backbone = TopDownPyramid(base=base, finest=finest).eval()
    with torch.no_grad():
        features = backbone(torch.rand(1, 3, 64, 96))
    assert backbone.info.matching_channels == matching
    for given, said in ((features.matching, matching), (features.guides, backbone.info.guide_channels)):
        assert {s: tuple(m.shape) for s, m in given.items()} == {s: (1, c, 64 // s, 96 // s) for s, c in said.items()}
    assert min(features.guides) == finest


@pytest.mark.parametrize("smooth", [True, False])
def test_maps_are_carried_down_by_sums(smooth):
    backbone = TopDownPyramid(base=DEEP, finest=1, smooth=smooth).eval()
    image = torch.rand(1, 3, 32, 32)
    with torch.no_grad():
        given, features = backbone.base(image), backbone(image)
        carried, expected = given.matching[4], {}
        for stride in (4, 2, 1):
            if stride < 4:
                carried = carried.repeat_interleave(2, 2).repeat_interleave(2, 3)
                carried = carried + backbone.laterals[str(stride)](given.guides[stride])
            plain = stride == 4 and not smooth
            expected[stride] = carried if plain else F.conv2d(carried, backbone.heads[str(stride)].weight, padding=1)
    for stride, value in expected.items():
        assert_close(features.matching[stride], value)


def test_every_weight_takes_part():
    backbone = TopDownPyramid(base={"name": "spatial_pyramid", "full_size": True}, finest=1)
    sum(m.square().sum() for m in backbone(torch.rand(2, 3, 32, 64)).matching.values()).backward()
    assert [name for name, p in backbone.named_parameters() if p.grad is None] == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"base": "spatial_pyramid", "finest": 1}, ["finest=1", "'spatial_pyramid' has them at 2, 4"]),
        ({"base": "spatial_pyramid", "finest": 4}, ["from stride 4 to finest=4"]),
        ({"base": "spatial_pyramid", "finest": 3}, ["finest=3"]),
        ({"base": {"finest": 2}}, ["the name of a backbone", "{'finest': 2}"]),
        ({"base": "spatial_pyramit"}, ["did you mean 'spatial_pyramid'"]),
        ({"base": "spatial_pyramid", "pretrained": True}, ["no pretrained weights to load"]),
    ],
)
def test_a_base_that_does_not_fit_is_refused(arguments, words):
    with pytest.raises(ConfigError) as error:
        TopDownPyramid(**arguments)
    assert all(word in str(error.value) for word in words), str(error.value)


def test_the_encoder_of_the_base_gets_its_weights(monkeypatch):
    asked = []
    monkeypatch.setattr(
        "stereokit.backbones.unet.build_encoder", lambda name, pretrained: asked.append(pretrained) or Widths()
    )
    TopDownPyramid(base="unet", pretrained=True)
    assert asked == [True]


class Widths(nn.Module):
    def __init__(self):
        super().__init__()
        self.channels = {4: 24, 8: 32, 16: 96, 32: 160}
