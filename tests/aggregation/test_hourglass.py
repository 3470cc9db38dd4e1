import pytest
import torch
from torch.testing import assert_close

from stereokit import GCE, ConfigError, Hourglass
from tests.aggregation.guided import (
    GUIDANCES,
    assert_gradients_are_right,
    assert_guides_matter,
    channels_at,
    guides_of,
)

CHANNELS = (2, 3, 4, 5)
GUIDES = channels_at(4, 8, 16, 32)


def hourglass(**arguments):
    return Hourglass(in_channels=1, channels=CHANNELS, guide_channels=GUIDES, **arguments)


@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_guidance_acts_where_it_is_placed(guidance, guidance_at):
    aggregation = hourglass(guidance=guidance, guidance_at=guidance_at)
    wanted = {} if guidance is None else {4: GUIDES[4]} if guidance_at == "one" else GUIDES
    assert aggregation.guide_channels == wanted
    volume, guides = torch.randn(2, 1, 8, 16, 24), guides_of(aggregation, (16, 24), stride=4, batch=2)
    (logits,) = aggregation(volume, guides)
    assert logits.shape == (2, 8, 16, 24)
    assert_guides_matter(aggregation, volume, guides)


def test_full_guidance_is_six_places():
    blocks = [m for m in hourglass(guidance=GCE, guidance_at="full").modules() if isinstance(m, GCE)]
    assert [(b.guide_channels, b.volume_channels) for b in blocks] == [
        (GUIDES[4], 2),
        (GUIDES[8], 3),
        (GUIDES[16], 4),
        (GUIDES[32], 5),
        (GUIDES[16], 4),
        (GUIDES[8], 3),
    ]
    assert len([m for m in hourglass(guidance=GCE, guidance_at="one").modules() if isinstance(m, GCE)]) == 1


@pytest.mark.parametrize("size", [(1, 1, 1), (5, 7, 9), (8, 16, 24), (13, 3, 20)])
def test_any_size_keeps_its_size(size):
    (logits,) = hourglass().eval()(torch.rand(1, 1, *size), {})
    assert logits.shape == (1, *size)


@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_gradients_are_right(guidance_at):
    aggregation = hourglass(guidance=GCE, guidance_at=guidance_at).double()
    guides = guides_of(aggregation, (16, 8), stride=4)
    assert_gradients_are_right(aggregation.eval(), torch.randn(1, 1, 8, 16, 8), guides)


def test_skips_join_the_scales():
    aggregation = hourglass().eval()
    seen = {}
    for name in ("down1", "down2", "down3", "up3", "up2"):
        module = getattr(aggregation, name)
        module.register_forward_hook(lambda _, inputs, output, name=name: seen.update({name: (inputs, output)}))
    aggregation(torch.randn(1, 1, 8, 16, 16), {})
    for up, coarse, skip in (("up3", "down3", "down2"), ("up2", "up3", "down1")):
        assert seen[up][0][0] is seen[coarse][1]
        assert seen[up][0][1] is seen[skip][1]


def test_one_step_up_merges_its_skip():
    up = hourglass().eval().up3
    volume, skip = torch.randn(1, 5, 2, 3, 3), torch.randn(1, 4, 4, 5, 6)
    joined = torch.cat((up.up(volume)[..., :5, :], skip), 1)
    assert_close(up(volume, skip, {}), up.convs(up.merge(joined)))


def test_every_weight_takes_part():
    aggregation = hourglass(guidance=GCE)
    guides = guides_of(aggregation, (16, 16), stride=4, batch=2)
    aggregation(torch.randn(2, 1, 8, 16, 16), guides)[0].square().sum().backward()
    assert [name for name, p in aggregation.named_parameters() if p.grad is None] == []


def test_full_guidance_wants_every_scale():
    with pytest.raises(ConfigError, match="stride 32 wants a guide of that stride; there are guides at 4, 8, 16"):
        Hourglass(in_channels=1, guidance=GCE, guidance_at="full", guide_channels=channels_at(4, 8, 16))
    assert Hourglass(in_channels=1, guidance=GCE, guidance_at="one", guide_channels={4: 8}).guide_channels == {4: 8}


def test_what_it_tells_the_network():
    aggregation = Hourglass(in_channels=5)
    assert (aggregation.in_channels, aggregation.multiple, aggregation.upscale) == (5, 8, 1)
    assert aggregation.loss_weights == (1,)


@pytest.mark.parametrize("size", [(1, 1, 1), (5, 7, 9), (4, 16, 24)])
def test_it_may_have_two_halvings(size):
    aggregation = Hourglass(in_channels=2, channels=(2, 3, 4), guidance=GCE, guide_channels=GUIDES)
    assert list(aggregation.guide_channels) == [4, 8, 16]
    assert aggregation.multiple == aggregation.planes_multiple == 4
    assert Hourglass(in_channels=2, channels=(2, 3, 4)).eval()(torch.rand(1, 2, *size), {})[0].shape == (1, *size)


@pytest.mark.parametrize("channels", [(2, 3), (2, 3, 4, 5, 6)])
def test_other_numbers_of_scales_are_refused(channels):
    with pytest.raises(ConfigError, match="two or three scales"):
        Hourglass(in_channels=2, channels=channels)
