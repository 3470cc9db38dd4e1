import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import ConfigError, InterlacedVolume
from stereokit.costs import interlaced_volume
from stereokit.costs.interlaced import SeenConvolution
from tests.strategies import feature_pairs, randn, seeds


def small(planes, **arguments):
    settings = {"reduction": (3, 2), "kernels": (2, 2), "channels": (3, 4), **arguments}
    return InterlacedVolume(in_channels=3, planes=planes, **settings).double()


def one_by_one(cost, left, right, planes):
    """Each disparity by itself, on the columns that both views see."""
    left, right = cost.reduction(left), cost.reduction(right)
    width = left.shape[-1]
    volume = left.new_zeros(len(left), planes, *left.shape[2:])
    for d in range(min(planes, width)):
        pair = [x for c in range(left.shape[1]) for x in (left[:, c, :, d:], right[:, c, :, : width - d])]
        x = torch.stack(pair, dim=1).unsqueeze(1)
        for layer in cost.layers:
            x = F.relu(layer.norm(layer.conv(x)))
        volume[:, d, :, d:] = F.relu(cost.merge.norm(cost.merge.conv(x.squeeze(2)))).squeeze(1)
    return volume.unsqueeze(1)


@given(feature_pairs())
def test_channels_of_both_views_alternate(pair):
    left, right, planes = pair
    volume, seen = interlaced_volume(left, right, planes)
    batch, channels, height, width = left.shape
    expected = left.new_zeros(batch, 2 * channels, planes, height, width)
    for d in range(min(planes, width)):
        for c in range(channels):
            expected[:, 2 * c, d, :, d:] = left[:, c, :, d:]
            expected[:, 2 * c + 1, d, :, d:] = right[:, c, :, : width - d]
    assert torch.equal(volume, expected)
    assert seen.shape == (batch, 1, planes, height, width)
    assert torch.equal(seen[0, 0, :, 0].sum(1), torch.arange(width, width - planes, -1).clamp(min=0).to(seen.dtype))


@given(seeds, st.integers(1, 11), st.integers(2, 9))
def test_planes_together_equal_one_after_the_other(seed, planes, width):
    cost = small(planes).eval()
    left, right = randn(seed, 2, 2, 3, 3, width, dtype=torch.float64)
    assert_close(cost(left, right), one_by_one(cost, left, right, planes))


@given(seeds)
def test_whole_candidates_are_planes(seed):
    cost = small(5).eval()
    left, right = randn(seed, 2, 1, 3, 3, 7, dtype=torch.float64)
    candidates = torch.arange(5.0, dtype=torch.float64).reshape(1, -1, 1, 1).expand(1, 5, 3, 7)
    assert_close(cost(left, right, candidates), cost(left, right))


@given(seeds)
def test_statistics_are_of_what_is_seen(seed):
    layer = SeenConvolution(torch.nn.Conv2d(2, 3, 3, padding=1)).double()
    x, seen = randn(seed, 2, 2, 4, 6, dtype=torch.float64), torch.ones(2, 1, 4, 6, dtype=torch.float64)
    assert_close(layer(x, seen), F.relu(layer.norm(layer.conv(x))))
    seen[0, ..., :4], seen[1, ..., :2] = 0, 0
    given = layer(x, seen)
    y = layer.conv(x)
    there = [y[0, :, :, 4:].flatten(1), y[1, :, :, 2:].flatten(1)]
    std, mean = torch.std_mean(torch.cat(there, dim=1), dim=1, correction=0, keepdim=True)
    expected = F.relu((y - mean.unsqueeze(-1)) / (std.unsqueeze(-1) ** 2 + layer.norm.eps).sqrt()) * seen
    assert_close(given, expected)


def test_gradients_are_right():
    cost = small(4)
    left, right = torch.randn(2, 1, 3, 3, 6, dtype=torch.float64)
    assert torch.autograd.gradcheck(cost, (left.requires_grad_(), right.requires_grad_()), fast_mode=True)


@pytest.mark.parametrize("wrong", [{"kernels": (2, 4)}, {"kernels": (4,)}, {"reduction": ()}])
def test_kernels_have_to_take_all_channels(wrong):
    with pytest.raises(ConfigError, match="expected one for each, of the product"):
        small(4, **wrong)


def test_it_is_of_the_published_size():
    cost = InterlacedVolume(in_channels=320, planes=48)
    assert sum(p.numel() for p in cost.layers.parameters()) == 1168 + 32 + 18464 + 64 + 9232 + 32
