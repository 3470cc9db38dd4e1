import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import GCE, ConfigError, EncoderDecoder
from tests.aggregation.guided import (
    GUIDANCES,
    assert_gradients_are_right,
    assert_guides_matter,
    channels_at,
    guides_of,
)

GUIDES = channels_at(2, 4, 8, 16, 32)


def encoder_decoder(**arguments):
    return EncoderDecoder(in_channels=3, channels=2, guide_channels=GUIDES, **arguments)


@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_guidance_acts_where_it_is_placed(guidance, guidance_at):
    aggregation = encoder_decoder(guidance=guidance, guidance_at=guidance_at)
    wanted = {} if guidance is None else {2: GUIDES[2]} if guidance_at == "one" else GUIDES
    assert aggregation.guide_channels == wanted
    volume, guides = torch.randn(2, 3, 16, 16, 32), guides_of(aggregation, (16, 32), stride=2, batch=2)
    (logits,) = aggregation(volume, guides)
    assert logits.shape == (2, 32, 32, 64)
    assert_guides_matter(aggregation, volume, guides)


def test_full_guidance_is_every_scale_down_and_up():
    blocks = [m for m in encoder_decoder(guidance=GCE, guidance_at="full").modules() if isinstance(m, GCE)]
    assert [(b.guide_channels, b.volume_channels) for b in blocks] == [
        (GUIDES[2], 3),
        (GUIDES[4], 4),
        (GUIDES[8], 4),
        (GUIDES[16], 4),
        (GUIDES[32], 8),
        (GUIDES[16], 4),
        (GUIDES[8], 4),
        (GUIDES[4], 4),
        (GUIDES[2], 2),
    ]


def test_one_guidance_acts_on_the_volume():
    aggregation = encoder_decoder(guidance=GCE, guidance_at="one").eval()
    volume, guides = torch.randn(1, 3, 16, 16, 16), guides_of(aggregation, (16, 16), stride=2)
    plain = encoder_decoder().eval()
    plain.load_state_dict(aggregation.state_dict(), strict=False)
    guided = aggregation.volume_guidance(volume, guides)
    assert_close(aggregation(volume, guides)[0], plain(guided, {})[0])


@pytest.mark.parametrize("size", [(1, 1, 1), (5, 7, 9), (8, 16, 24), (13, 3, 20)])
def test_any_size_is_doubled(size):
    (logits,) = encoder_decoder().eval()(torch.rand(1, 3, *size), {})
    assert logits.shape == (1, *(2 * side for side in size))


def test_skips_are_added():
    aggregation = encoder_decoder().eval()
    for level in (aggregation.up0, aggregation.up1, aggregation.up2, aggregation.up3):
        nn.init.zeros_(level.up[1].weight)
    volume = torch.randn(1, 3, 16, 16, 16)
    # with the decoder silent, the finest skip alone is left
    assert_close(aggregation(volume, {})[0], aggregation.head(aggregation.skip0(volume)).squeeze(1))


@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_gradients_are_right(guidance_at):
    aggregation = encoder_decoder(guidance=GCE, guidance_at=guidance_at).double().eval()
    assert_gradients_are_right(aggregation, torch.randn(1, 3, 4, 16, 16), guides_of(aggregation, (16, 16), stride=2))


def test_every_weight_takes_part():
    aggregation = encoder_decoder(guidance=GCE, guidance_at="full")
    guides = guides_of(aggregation, (16, 16), stride=2, batch=2)
    aggregation(torch.randn(2, 3, 16, 16, 16), guides)[0].square().sum().backward()
    assert [name for name, p in aggregation.named_parameters() if p.grad is None] == []


def test_full_guidance_wants_every_scale():
    with pytest.raises(ConfigError, match="stride 32 wants a guide of that stride; there are guides at 2, 4, 8, 16"):
        EncoderDecoder(in_channels=3, guidance=GCE, guidance_at="full", guide_channels=channels_at(2, 4, 8, 16))


def test_what_it_tells_the_network():
    aggregation = EncoderDecoder(in_channels=5)
    assert (aggregation.in_channels, aggregation.multiple, aggregation.upscale) == (5, 16, 2)
    assert aggregation.loss_weights == (1,)
