import torch
from torch.testing import assert_close

from stereokit import AffinityPyramid


def test_maps_are_fused_from_pools_of_one_affinity():
    torch.manual_seed(0)
    backbone = AffinityPyramid(channels=4).eval()
    images = torch.rand(1, 3, 36, 44)
    features = backbone(images)
    assert {s: tuple(m.shape) for s, m in features.guides.items()} == {2: (1, 32, 18, 22), 4: (1, 4, 9, 11)}
    maps = backbone.maps(images)
    joined = backbone.join(torch.cat((maps.layer2, maps.layer4), dim=1))
    pooled = [branch(joined, backbone.affinity(joined)) for branch in backbone.branches]
    assert [branch.cell for branch in backbone.branches] == [4, 8, 16, 32]
    assert_close(features.matching[4], backbone.fusion(torch.stack(pooled, dim=1), joined))
