"""What is SegStereo's own."""

import pytest
import torch
from torch import nn

from stereokit import ConfigError, build_model
from stereokit.models.segstereo import Bottleneck, Semantics


def test_its_parts_have_the_published_sizes():
    model = build_model("segstereo")
    sizes = {name: sum(p.numel() for p in part.parameters()) for name, part in model.named_children()}
    assert sizes["shallow"] + sizes["semantics"] == 24_161_491 - 4_883
    assert sizes["embedding"] == 33_024
    assert sizes["matching"] + sizes["transform"] + sizes["regressor"] == 36_608_737


@pytest.mark.parametrize(("name", "channels"), [("segstereo", 256 + 25 + 128), ("resnetcorr", 256 + 33)])
def test_as_many_displacements_are_compared_as_published(name, channels):
    assert build_model(name).regressor[0].reduce[0].in_channels == channels


def test_what_is_far_away_reaches_a_pixel_by_its_semantics_alone():
    """The means over cells see the whole image."""
    torch.manual_seed(0)
    semantics = Semantics().eval()
    x = torch.rand(1, 512, 4, 40)
    changed = x.clone()
    changed[..., -1] += 1
    with torch.inference_mode():
        near = (semantics(changed) - semantics(x)).abs().amax(dim=(0, 1, 2))
        trunk = (semantics.trunk(changed) - semantics.trunk(x)).abs().amax(dim=(0, 1, 2))
    assert trunk[0] == 0
    assert near[0] > 0


def test_a_bottleneck_without_its_last_convolution_is_its_skip():
    block = Bottleneck(16, 4, 16).eval()
    nn.init.zeros_(block.expand[0].weight)
    x = torch.randn(1, 16, 5, 6)
    assert torch.equal(block(x), x.relu())


def test_disparity_is_never_negative_and_has_no_confidence():
    model = build_model("resnetcorr", max_disparity=32).eval()
    nn.init.constant_(model.regressor[-1].bias, -1000.0)
    with torch.inference_mode():
        output = model(*torch.rand(2, 1, 3, 64, 64))
    assert (output.disparity == 0).all()
    assert output.confidence is None


@pytest.mark.parametrize("max_disparity", [0, -8, 30, 32.0, True])
def test_the_reach_is_a_multiple_of_eight(max_disparity):
    with pytest.raises(ConfigError, match="max_disparity"):
        build_model("segstereo", max_disparity=max_disparity)
