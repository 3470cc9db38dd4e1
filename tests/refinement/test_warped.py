import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import ConfigError, WarpedRefinement, build_model
from tests.strategies import randn, seeds


def refinement(**arguments):
    return WarpedRefinement(dilations=(1, 2), **arguments).eval()


@given(st.sampled_from([1, 2, 3]), st.integers(1, 3), seeds)
def test_without_a_residual_it_resizes_and_keeps_pixels(stride, coarser, seed):
    left, right = randn(seed, 2, 1, 3, 18, 36, dtype=torch.float64)
    block = refinement(stride=stride).double()
    for weight in block.head.parameters():
        nn.init.zeros_(weight)
    size = (18 // stride, 36 // stride)
    coarse = 50 * randn(seed, 1, size[0] // coarser, size[1] // coarser, dtype=torch.float64).abs()
    expected = F.interpolate(coarse.unsqueeze(1), size, mode="bilinear", align_corners=False).squeeze(1)
    assert_close(block(coarse, left, right, {}), expected)


@given(st.integers(0, 6), seeds)
def test_it_sees_the_difference_of_the_views(shift, seed):
    """Where the disparity is right, the warped view is the left one but for the border."""
    scene = randn(seed, 1, 3, 6, 30)
    left, right = scene[..., :24], scene[..., shift : 24 + shift]
    block, seen = refinement(), []
    block.of_images.register_forward_pre_hook(lambda _, given_: seen.append(given_[0]))
    block(torch.full((1, 6, 24), float(shift)), left, right, {})
    assert_close(seen[0][:, :3, :, shift:], torch.zeros(1, 3, 6, 24 - shift), atol=1e-4, rtol=0)
    # beyond the border it is continued
    assert_close(seen[0][:, :3, :, :shift], (right[..., :1] - left)[..., :shift], atol=1e-4, rtol=0)
    assert_close(seen[0][:, 3:], left)


@pytest.mark.parametrize("body", ["dilated", "hourglass"])
def test_all_that_it_reads_matters(body):
    block = WarpedRefinement(stride=2, body=body)
    disparity, left, right = (
        x.requires_grad_() for x in (10 + torch.rand(1, 8, 8), torch.randn(1, 3, 64, 64), torch.randn(1, 3, 64, 64))
    )
    refined = block(disparity, left, right, {})
    assert refined.shape == (1, 32, 32)
    assert (refined >= 0).all()
    refined.sum().backward()
    assert all(x.grad.any() for x in (disparity, left, right))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stride": 0}, "whole number from 1 up"),
        ({"body": "deep"}, "use 'dilated' or 'hourglass'"),
        ({"body": "hourglass", "dilations": [1]}, "have no effect"),
    ],
)
def test_what_can_not_be_is_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        WarpedRefinement(**arguments)


def test_the_image_is_padded_to_what_its_hourglass_divides():
    hourglasses = [{"name": "warped", "stride": stride, "body": "hourglass"} for stride in (2, 1)]
    assert build_model("aanet", max_disparity=48).multiple == 12
    assert build_model("aanet", max_disparity=48, refinements=hourglasses).multiple == 96
