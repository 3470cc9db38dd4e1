import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import MatchingNetwork
from tests.strategies import randn, seeds


def small(planes):
    return MatchingNetwork(in_channels=3, planes=planes, width=4, out_channels=2, blocks=1).double()


def one_by_one(cost, left, right, planes):
    """As published: the views concatenated, one disparity after the other."""
    weight = torch.cat((cost.of_left.weight, cost.of_right.weight), dim=1)
    width, volume = left.shape[-1], []
    for d in range(planes):
        shifted = torch.zeros_like(right)
        if d < width:
            shifted[..., d:] = right[..., : width - d]
        x = F.conv2d(torch.cat((left, shifted), dim=1), weight, cost.of_left.bias, padding=1)
        volume.append(cost.head(cost.blocks(x)))
    return torch.stack(volume, dim=2)


@given(seeds, st.integers(1, 11), st.integers(2, 9), st.booleans())
def test_planes_together_equal_one_after_the_other(seed, planes, width, training):
    cost = small(planes).train(training)
    left, right = randn(seed, 2, 2, 3, 3, width, dtype=torch.float64)
    assert_close(cost(left, right), one_by_one(cost, left, right, planes))


@given(seeds)
def test_whole_candidates_are_planes(seed):
    cost = small(5)
    left, right = randn(seed, 2, 1, 3, 3, 7, dtype=torch.float64)
    candidates = torch.arange(5.0, dtype=torch.float64).reshape(1, -1, 1, 1).expand(1, 5, 3, 7)
    assert_close(cost(left, right, candidates), cost(left, right))


def test_gradients_are_right():
    left, right = torch.randn(2, 1, 3, 3, 6, dtype=torch.float64)
    assert torch.autograd.gradcheck(small(4), (left.requires_grad_(), right.requires_grad_()), fast_mode=True)


def test_it_is_of_the_published_size():
    assert sum(p.numel() for p in MatchingNetwork(in_channels=64, planes=48).parameters()) == 226_632
