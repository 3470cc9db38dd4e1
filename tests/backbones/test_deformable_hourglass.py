import pytest
import torch

from stereokit import ConfigError, DeformableHourglass


@pytest.mark.parametrize(("scales", "deformable"), [(1, False), (3, True)])
def test_features_are_what_the_info_says(scales, deformable):
    backbone = DeformableHourglass(scales=scales, deformable=deformable).eval()
    features = backbone(torch.rand(2, 3, 48, 48))
    assert backbone.info.matching_channels == {3 << s: 32 << s for s in range(scales)}
    for stride, x in features.matching.items():
        assert x.shape == (2, backbone.info.matching_channels[stride], 48 // stride, 48 // stride)
        assert features.guides[stride] is x


def test_other_scales_are_refused():
    with pytest.raises(ConfigError, match="1, 2 or 3 scales"):
        DeformableHourglass(scales=0)
