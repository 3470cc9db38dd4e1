import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import GCE, ConfigError, GwcHourglass
from stereokit.aggregation.gwc_hourglass import DoublingHourglass
from tests.aggregation.guided import (
    GUIDANCES,
    assert_gradients_are_right,
    assert_guides_matter,
    assert_the_second_pair_is_residual,
    channels_at,
    guides_of,
    with_running_statistics,
)

GUIDES = channels_at(4, 8, 16)
HEADS = ("head0", "head1", "head2", "head3")
HOURGLASSES = ("hourglass1", "hourglass2", "hourglass3")


def gwc(in_channels=3, **arguments):
    return GwcHourglass(in_channels=in_channels, channels=2, guide_channels=GUIDES, **arguments)


@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_guidance_acts_where_it_is_placed(guidance, guidance_at):
    aggregation = gwc(guidance=guidance, guidance_at=guidance_at)
    wanted = {} if guidance is None else {4: GUIDES[4]} if guidance_at == "one" else GUIDES
    assert aggregation.guide_channels == wanted
    volume, guides = torch.randn(2, 3, 8, 8, 12), guides_of(aggregation, (8, 12), stride=4, batch=2)
    assert [logits.shape for logits in aggregation(volume, guides)] == 4 * [(2, 8, 8, 12)]
    assert_guides_matter(aggregation, volume, guides)


def test_full_guidance_is_three_places_per_hourglass():
    blocks = [m for m in gwc(guidance=GCE, guidance_at="full").modules() if isinstance(m, GCE)]
    channels = [(b.guide_channels, b.volume_channels) for b in blocks]
    assert channels == [(GUIDES[4], 2), *3 * [(GUIDES[8], 4), (GUIDES[16], 8), (GUIDES[8], 4)]]


def test_eval_mode_gives_the_last_head():
    aggregation, volume = with_running_statistics(gwc()), torch.randn(1, 3, 4, 8, 8)
    heads = aggregation(volume, {})
    (best,) = aggregation.eval()(volume, {})
    assert_close(best, heads[-1])


def test_no_head_adds_to_another():
    aggregation, volume = with_running_statistics(gwc()), torch.randn(1, 3, 4, 8, 8)
    for number, name in enumerate(HEADS):
        nn.init.zeros_(getattr(aggregation, name)[-1].weight)
        assert [bool(logits.any()) for logits in aggregation(volume, {})] == [i > number for i in range(4)]


def test_hourglasses_follow_each_other_and_each_is_judged():
    aggregation = with_running_statistics(gwc())
    entered, left, judged = [], [], []
    for name in HOURGLASSES:
        getattr(aggregation, name).register_forward_pre_hook(lambda _, inputs: entered.append(inputs[0]))
        getattr(aggregation, name).register_forward_hook(lambda _, inputs, output: left.append(output))
    for name in HEADS:
        getattr(aggregation, name).register_forward_pre_hook(lambda _, inputs: judged.append(inputs[0]))
    aggregation(torch.randn(1, 3, 4, 8, 8), {})
    assert [id(x) for x in judged] == [id(x) for x in (entered[0], *left)]
    assert [id(x) for x in entered[1:]] == [id(x) for x in left[:2]]


def test_the_second_pair_is_residual():
    assert_the_second_pair_is_residual(gwc(), torch.randn(1, 3, 4, 8, 8))


def test_one_hourglass_skips_by_convolutions():
    hourglass = DoublingHourglass(3).eval()
    x = torch.randn(1, 3, 4, 6, 6)
    half = hourglass.conv2(hourglass.conv1(x))
    up = hourglass.conv5(hourglass.conv4(hourglass.conv3(half)))[..., :3, :3]
    up = (up + hourglass.skip2(half)).relu()
    assert_close(hourglass(x, {}), (hourglass.conv6(up) + hourglass.skip1(x)).relu())


def test_the_width_doubles_with_every_halving_as_published():
    hourglass = DoublingHourglass(32)
    assert hourglass.conv4[0].out_channels == 128
    assert sum(p.numel() for p in hourglass.parameters()) == 1_112_192
    assert sum(p.numel() for p in GwcHourglass(in_channels=40).head0.parameters()) == 28_576


@pytest.mark.parametrize("size", [(1, 1, 1), (5, 7, 9), (8, 16, 24), (13, 3, 20)])
def test_any_size_keeps_its_size(size):
    (logits,) = gwc().eval()(torch.rand(1, 3, *size), {})
    assert logits.shape == (1, *size)


@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_gradients_are_right(guidance_at):
    aggregation = with_running_statistics(gwc(guidance=GCE, guidance_at=guidance_at).double())
    assert_gradients_are_right(aggregation, torch.randn(1, 3, 4, 8, 4), guides_of(aggregation, (8, 4), stride=4))


def test_every_weight_takes_part_in_training():
    aggregation = gwc(guidance=GCE, guidance_at="full")
    heads = aggregation(torch.randn(2, 3, 8, 8, 8), guides_of(aggregation, (8, 8), stride=4, batch=2))
    sum(logits.square().sum() for logits in heads).backward()
    assert [name for name, p in aggregation.named_parameters() if p.grad is None] == []


def test_full_guidance_wants_every_scale():
    with pytest.raises(ConfigError, match="stride 16 wants a guide of that stride; there are guides at 4, 8"):
        GwcHourglass(in_channels=3, guidance=GCE, guidance_at="full", guide_channels=channels_at(4, 8))


def test_what_it_tells_the_network():
    aggregation = GwcHourglass(in_channels=5)
    assert (aggregation.in_channels, aggregation.multiple, aggregation.upscale) == (5, 4, 1)
    assert aggregation.loss_weights == (0.5, 0.5, 0.7, 1.0)
