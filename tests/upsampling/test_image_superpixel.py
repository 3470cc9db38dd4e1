import pytest
import torch
from torch.testing import assert_close

from stereokit import ConfigError, ImageSuperpixelUpsampler
from stereokit.upsampling.superpixel import superpixel_upsample
from tests.upsampling.test_superpixel import PADDINGS, guides_for


def upsampler(scale=4, **arguments):
    return ImageSuperpixelUpsampler(scale=scale, guide_channels={1: 3, 2: 5, 4: 6, 8: 7, 16: 8}, **arguments).eval()


@pytest.mark.parametrize(
    ("scale", "read"), [(4, {1: 3, 4: 6}), (8, {1: 3, 4: 6, 8: 7}), (16, {1: 3, 4: 6, 8: 7, 16: 8})]
)
def test_image_and_guides_decide_the_weights(scale, read):
    block = upsampler(scale)
    assert block.guide_channels == read
    maps = {s: g.requires_grad_() for s, g in guides_for(block, batch=2).items()}
    weights = block.weights(maps)
    assert weights.shape == (2, 9, 3 * scale, 5 * scale)
    assert_close(weights.sum(1), torch.ones(2, 3 * scale, 5 * scale))
    weights[:, 0].sum().backward()
    assert all(g.grad.abs().sum() > 0 for g in maps.values())


@pytest.mark.parametrize("padding", PADDINGS)
def test_the_module_is_its_function(padding):
    block = upsampler(padding=padding)
    guides, disparity = guides_for(block), torch.rand(1, 3, 5)
    assert_close(block(disparity, guides), superpixel_upsample(disparity, block.weights(guides), padding=padding))


def test_the_edge_is_replicated_unless_told_otherwise():
    block = upsampler()
    assert_close(block(torch.full((1, 3, 5), 3.0), guides_for(block)), torch.full((1, 12, 20), 3.0))


def test_weights_are_never_in_half_precision():
    block = upsampler()
    with torch.autocast("cpu", torch.bfloat16):
        assert block.weights(guides_for(block)).dtype == torch.float32


def test_every_weight_takes_part():
    block = upsampler(8).train()
    block(torch.rand(2, 3, 5), guides_for(block, batch=2)).square().sum().backward()
    assert [name for name, p in block.named_parameters() if p.grad is None] == []


@pytest.mark.parametrize(("scale", "stride"), [(2, 2), (4, 8), (2, 4)])
def test_it_ends_at_full_resolution(scale, stride):
    with pytest.raises(ConfigError, match=f"it is to grow by {scale} from stride {stride}: use 'superpixel'"):
        upsampler(scale, stride=stride)


@pytest.mark.parametrize(("guides", "missing"), [({8: 7, 4: 6}, "1"), ({1: 3, 8: 7}, "4"), ({8: 7}, "1, 4")])
def test_missing_guides_are_named(guides, missing):
    with pytest.raises(ConfigError, match=f"wants guides at stride {missing} too"):
        ImageSuperpixelUpsampler(scale=8, guide_channels=guides)


def test_unknown_padding_is_refused():
    with pytest.raises(ConfigError, match="'reflect' is unknown; use 'replicate' or 'zeros'"):
        upsampler(padding="reflect")
