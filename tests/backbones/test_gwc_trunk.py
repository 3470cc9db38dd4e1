import pytest
import torch
from torch.testing import assert_close

from stereokit import GwcTrunk


@pytest.mark.parametrize("full_size", [False, True])
def test_features_are_what_the_info_says(full_size):
    backbone = GwcTrunk(full_size=full_size).eval()
    with torch.no_grad():
        features = backbone(torch.rand(1, 3, 32, 44))
    for given, said in (
        (features.matching, backbone.info.matching_channels),
        (features.guides, backbone.info.guide_channels),
    ):
        assert {s: tuple(m.shape) for s, m in given.items()} == {s: (1, c, 32 // s, 44 // s) for s, c in said.items()}
    assert set(features.guides) == ({1, 2, 4} if full_size else {2, 4})


def test_the_layers_at_a_quarter_lie_side_by_side():
    backbone, seen = GwcTrunk().eval(), []
    for layer in (backbone.layer1, backbone.layer2, backbone.layer3, backbone.layer4):
        layer.register_forward_hook(lambda _module, _inputs, output: seen.append(output))
    matching = backbone(torch.rand(1, 3, 32, 32)).matching
    assert matching[2] is seen[0]
    assert_close(matching[4], torch.cat(seen[1:], dim=1), rtol=0, atol=0)


def test_the_published_size():
    # the pyramid of PSMNet is left out
    assert sum(p.numel() for p in GwcTrunk().parameters()) == 2_949_920
    assert sum(p.numel() for p in GwcTrunk(full_size=True).parameters()) == 2_949_920


def test_every_weight_takes_part():
    backbone = GwcTrunk()
    backbone(torch.rand(2, 3, 32, 64)).matching[4].square().sum().backward()
    assert [name for name, p in backbone.named_parameters() if p.grad is None] == []
