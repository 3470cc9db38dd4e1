import pytest
import torch
from torch.testing import assert_close

from stereokit import LevelPathBackbone


@pytest.mark.parametrize("levels", [[0], [1], [1, 0, 2]])
def test_features_are_what_the_info_says_wherever_the_path_ends(levels):
    backbone = LevelPathBackbone(levels=levels, filters=2).eval()
    features = backbone(torch.rand(2, 3, 36, 30))
    assert backbone.info.matching_channels == {3: 8}
    assert backbone.info.guide_channels == {1: 4, 3: 8}
    assert features.matching[3].shape == (2, 8, 12, 10)
    assert {s: tuple(g.shape) for s, g in features.guides.items()} == {1: (2, 4, 36, 30), 3: (2, 8, 12, 10)}


def test_it_has_the_size_of_the_published_one():
    # less the norm of its last convolution and what the ladder does not use
    assert sum(p.numel() for p in LevelPathBackbone().parameters()) == 99_792 - 64 - 2_112 - 8_320 - 33_024


def test_the_path_begins_with_the_second_and_third_convolution():
    backbone = LevelPathBackbone(levels=[0], filters=1).eval()
    images, seen = torch.rand(1, 3, 12, 12), []
    backbone.path.register_forward_pre_hook(lambda _, inputs: seen.extend(inputs))
    backbone(images)
    second = backbone.stem1(backbone.stem0(images))
    assert_close(seen, [second, backbone.stem2(second)])
