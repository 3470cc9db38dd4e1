import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import SpatialPyramid
from stereokit.backbones.spatial_pyramid import PooledBranch


@pytest.mark.parametrize(("height", "width"), [(32, 36), (64, 96), (256, 260)])
def test_features_are_what_the_info_says(height, width):
    backbone = SpatialPyramid().eval()
    info = backbone.info
    with torch.no_grad():
        features = backbone(torch.rand(1, 3, height, width))
    assert (info.matching_channels, backbone.multiple) == ({4: 32}, 4)
    assert features.matching[4].shape == (1, 32, height // 4, width // 4)
    assert {s: tuple(g.shape) for s, g in features.guides.items()} == {
        s: (1, c, height // s, width // s) for s, c in info.guide_channels.items()
    }
    assert features.guides[4] is features.matching[4]


def pooled(x, pool):
    branch = PooledBranch(x.shape[1], x.shape[1], pool)
    branch.conv = nn.Identity()
    return branch(x)


@pytest.mark.parametrize(("height", "width"), [(3, 5), (8, 8), (2, 11)])
def test_a_map_smaller_than_the_pool_is_pooled_whole(height, width):
    x = torch.rand(1, 2, height, width)
    assert_close(pooled(x, 64), x.mean((2, 3), keepdim=True).expand_as(x))


def test_sides_are_clamped_one_by_one():
    x = torch.rand(1, 2, 3, 16)
    means = torch.stack((x[..., :8].mean((2, 3)), x[..., 8:].mean((2, 3))), -1)
    result = pooled(x, 8)
    assert_close(result[:, :, 0, 0], means[..., 0])
    assert_close(result[:, :, 0, -1], means[..., 1])
    assert_close(result, result[:, :, :1].expand_as(x))


def test_a_larger_map_keeps_its_mean_by_windows():
    x = torch.rand(1, 1, 8, 8)
    result = pooled(x, 4)
    assert_close(result[0, 0, 0, 0], x[0, 0, :4, :4].mean())
    assert_close(result[0, 0, -1, -1], x[0, 0, 4:, 4:].mean())


def test_the_published_depth():
    backbone = SpatialPyramid()
    layers = [backbone.layer1, backbone.layer2, backbone.layer3, backbone.layer4]
    assert [len(layer) for layer in layers] == [3, 16, 3, 3]
    assert {b.conv1[0].dilation for b in backbone.layer4} == {b.conv2[0].dilation for b in backbone.layer4} == {(2, 2)}
    assert {b.conv1[0].dilation for layer in layers[:3] for b in layer} == {(1, 1)}
    assert [branch.pool for branch in backbone.branches] == [8, 16, 32, 64]


def test_every_weight_takes_part():
    backbone = SpatialPyramid(channels=8)
    backbone(torch.rand(2, 3, 32, 64)).matching[4].square().sum().backward()
    assert [name for name, p in backbone.named_parameters() if p.grad is None] == []
    assert backbone.info.guide_channels == {2: 32, 4: 8}
