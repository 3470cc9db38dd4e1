"""What is HD3's own."""

import pytest
import torch
from torch.testing import assert_close

from stereokit.layers import bilinear_upsample
from stereokit.models.hd3 import STRIDES, Density, Level


def a_level(**arguments):
    torch.manual_seed(0)
    return Level(6, **{"first": False, "last": False, "context": False} | arguments).eval()


def density(disparity):
    maps = torch.rand(len(disparity), 9, *(2 * side for side in disparity.shape[1:]))
    return Density(torch.empty(0), torch.empty(0), disparity, torch.empty(0), maps)


def test_a_scale_looks_around_what_the_one_before_says():
    before = density(3 * torch.rand(1, 3, 4))
    found = a_level()(*torch.rand(2, 1, 6, 6, 8), before)
    expected = 2 * bilinear_upsample(before.disparity, 2, align_corners=True)
    assert_close(found.candidates, torch.stack([expected + step for step in range(-4, 5)], dim=1))
    away = (found.disparity - expected).abs()
    assert (away <= 4 + 1e-5).all()
    assert (found.disparity >= 0).all()
    assert found.map.shape == (1, 9, 12, 16)


@pytest.mark.parametrize("residual", [-3, 0, 2])
def test_classes_are_in_the_order_of_the_correlation(residual):
    """A head that copies the correlation finds what is left of the disparity."""
    level = a_level(context=True, last=True)
    # of unit length, so that nothing is as like a pixel as itself
    scene = torch.nn.functional.normalize(torch.randn(1, 6, 8, 40), dim=1)
    left, right = scene[..., :32], scene[..., 6:38]

    class Copy(torch.nn.Module):
        def forward(self, x):
            return x[:, :9]

    level.decoder, level.head = Copy(), torch.nn.Identity()
    before = density(torch.full((1, 4, 16), (6 - residual) / 2))
    found = level(left, right, before)
    best = found.candidates.gather(1, found.logits.argmax(1, keepdim=True)).squeeze(1)[..., 12:-8]
    assert_close(best, torch.full_like(best, 6))
    assert found.map is None


def test_the_gradient_flows_into_the_scales_before():
    level = a_level()
    disparity = (1 + torch.rand(1, 3, 4)).requires_grad_()
    level(*torch.rand(2, 1, 6, 6, 8), density(disparity)).disparity.sum().backward()
    assert disparity.grad.any()


def test_scales_halve_from_64_to_2():
    assert STRIDES == (64, 32, 16, 8, 4, 2)
