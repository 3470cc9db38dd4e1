import pytest
import torch
from torch import nn
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import BottleneckPyramid, ConfigError


@pytest.mark.parametrize("scales", [1, 2, 3])
def test_features_are_what_the_info_says(scales):
    backbone = BottleneckPyramid(channels=6, blocks=(1, 1, 1), scales=scales).eval()
    features = backbone(torch.rand(2, 3, 36, 24))
    assert backbone.info.matching_channels == backbone.info.guide_channels == {3 << s: 6 for s in range(scales)}
    for stride, x in features.matching.items():
        assert x.shape == (2, 6, 36 // stride, 24 // stride)
        assert features.guides[stride] is x


def test_coarser_maps_are_added_to_finer_ones():
    backbone = BottleneckPyramid(channels=4, blocks=(1, 1, 1)).eval()
    fine, half, _ = backbone.laterals
    for layer in (fine, half):
        nn.init.zeros_(layer.weight)
        nn.init.zeros_(layer.bias)
    seen = {}
    for stride, layer in zip((3, 6, 12), (*backbone.heads[:2], backbone.laterals[2]), strict=True):
        layer.register_forward_hook(lambda _, given, output, stride=stride: seen.update({stride: (given[0], output)}))
    backbone(torch.rand(1, 3, 24, 36))
    coarsest = seen[12][1]
    assert_close(seen[6][0], F.interpolate(coarsest, scale_factor=2))
    assert_close(seen[3][0], F.interpolate(coarsest, scale_factor=4))


def test_other_scales_are_refused():
    with pytest.raises(ConfigError, match="1, 2 or 3 scales"):
        BottleneckPyramid(scales=4)
