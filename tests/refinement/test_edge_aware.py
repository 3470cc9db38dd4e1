import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import ConfigError, EdgeAwareRefinement, build_model
from tests.strategies import randn, seeds


def silent(**arguments):
    """A refinement that leaves the disparity as it is."""
    block = EdgeAwareRefinement(channels=4, **arguments).eval().double()
    nn.init.zeros_(block.head.weight)
    nn.init.zeros_(block.head.bias)
    return block


@given(st.sampled_from([1, 2, 4]), st.integers(0, 2), st.booleans(), seeds)
def test_without_a_residual_it_resizes_and_keeps_pixels(stride, halvings, align_corners, seed):
    left, right = randn(seed, 2, 1, 3, 16, 32, dtype=torch.float64)
    size = (16 // stride, 32 // stride)
    coarse = 50 * randn(seed, 1, size[0] >> halvings, size[1] >> halvings, dtype=torch.float64).abs()
    refined = silent(stride=stride, align_corners=align_corners)(coarse, left, right, {})
    expected = F.interpolate(coarse.unsqueeze(1), size, mode="bilinear", align_corners=align_corners).squeeze(1)
    assert_close(refined, expected)
    assert refined.max() <= coarse.max() + 1e-9
    if halvings == 0:
        assert_close(refined, coarse, rtol=0, atol=1e-12)


@given(seeds)
def test_the_disparity_is_never_negative(seed):
    left, right = randn(seed, 2, 2, 3, 16, 16)
    torch.manual_seed(seed)
    refined = EdgeAwareRefinement(channels=4)(randn(seed, 2, 16, 16).abs(), left, right, {})
    assert refined.shape == (2, 16, 16)
    assert (refined >= 0).all()


def test_the_image_and_the_disparity_matter_and_the_right_image_does_not():
    block = EdgeAwareRefinement(channels=4, stride=2)
    disparity, left, right = (
        x.requires_grad_() for x in (10 + torch.rand(1, 4, 4), torch.randn(1, 3, 16, 16), torch.randn(1, 3, 16, 16))
    )
    block(disparity, left, right, {}).sum().backward()
    assert disparity.grad.any()
    assert left.grad.any()
    assert right.grad is None


def test_gradients_are_right():
    block = EdgeAwareRefinement(channels=2, dilations=(1, 2), stride=2).eval().double()
    left, right = torch.randn(2, 1, 3, 8, 8, dtype=torch.float64)
    disparity = (20 + torch.rand(1, 2, 2, dtype=torch.float64)).requires_grad_()
    left.requires_grad_()
    assert torch.autograd.gradcheck(lambda d, i: block(d, i, right, {}), (disparity, left), fast_mode=True)


@given(seeds)
def test_it_moves_with_the_scene(seed):
    block = EdgeAwareRefinement(channels=3, dilations=(1, 2)).eval().double()
    left, right = randn(seed, 2, 1, 3, 20, 36, dtype=torch.float64)
    disparity = 30 * randn(seed, 1, 20, 36, dtype=torch.float64).abs()
    whole = block(disparity, left, right, {})
    part = block(disparity[..., 4:], left[..., 4:], right[..., 4:], {})
    # 8 pixels see the border: 1 of each plain convolution, 2 by 1 and 2 by 2 of the dilated ones
    assert_close(part[..., 8:], whole[..., 12:])


def test_the_published_dilations_see_far():
    block = EdgeAwareRefinement().eval()
    left = torch.zeros(1, 3, 5, 101).requires_grad_()
    block(torch.ones(1, 5, 101), left, left, {})[0, 2, 50].backward()
    columns = left.grad.abs().sum((0, 1, 2)).nonzero()
    # two convolutions for each of 1, 2, 4, 8, 1, 1 and the two plain ones
    assert columns.min() >= 50 - 36
    assert columns.max() <= 50 + 36
    assert columns.max() - columns.min() > 40


@pytest.mark.parametrize("stride", [0, -2, 1.5, True, "2"])
def test_a_stride_that_is_none_is_refused(stride):
    with pytest.raises(ConfigError, match="whole number from 1 up"):
        EdgeAwareRefinement(stride=stride)
    with pytest.raises(ConfigError, match="whole number from 1 up"):
        build_model("gcnet", max_disparity=32, refinements=[{"name": "edge_aware", "stride": stride}])


@pytest.mark.parametrize("network", ["coex", "gcnet"])
def test_it_mends_other_networks(network):
    model = build_model(network, max_disparity=64, refinements=["edge_aware"])
    assert model.config["refinements"][0]["name"] == "edge_aware"
    assert build_model(model.config).config == model.config
    plain = build_model(network, max_disparity=64)
    assert model.loss_weights == (*plain.loss_weights, 1.0)
    images = torch.rand(2, 1, 3, 64, 96)
    for head in (model.refinements[0].head.weight, model.refinements[0].head.bias):
        nn.init.zeros_(head)
    plain.load_state_dict(model.state_dict(), strict=False)
    with torch.inference_mode():
        given, expected = model.eval()(*images), plain.eval()(*images)
    assert_close(given.disparity, expected.disparity)
    assert_close(given.confidence, expected.confidence)


def test_an_upsampler_ends_where_the_first_refinement_begins():
    refinements = [{"name": "edge_aware", "stride": stride} for stride in (2, 1)]
    model = build_model("coex", max_disparity=64, upsampler="bilinear", refinements=refinements)
    assert model.upsampler.scale == 2
    assert model(*torch.rand(2, 1, 3, 40, 50)).disparity.shape == (1, 40, 50)
    module = build_model(
        "coex",
        max_disparity=64,
        upsampler="bilinear",
        refinements=[EdgeAwareRefinement(stride=2), EdgeAwareRefinement()],
    )
    assert module.upsampler.scale == 2
