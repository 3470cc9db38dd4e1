import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import GCE, ConfigError, StackedHourglass
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


def stacked(in_channels=3, **arguments):
    return StackedHourglass(in_channels=in_channels, channels=2, guide_channels=GUIDES, **arguments)


@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
@pytest.mark.parametrize("in_channels", [1, 3])
def test_guidance_acts_where_it_is_placed(guidance, guidance_at, in_channels):
    aggregation = stacked(in_channels, guidance=guidance, guidance_at=guidance_at)
    wanted = {} if guidance is None else {4: GUIDES[4]} if guidance_at == "one" else GUIDES
    assert aggregation.guide_channels == wanted
    volume, guides = torch.randn(2, in_channels, 8, 8, 12), guides_of(aggregation, (8, 12), stride=4, batch=2)
    assert [logits.shape for logits in aggregation(volume, guides)] == 3 * [(2, 8, 8, 12)]
    assert_guides_matter(aggregation, volume, guides)


def test_full_guidance_is_three_places_per_hourglass():
    blocks = [m for m in stacked(guidance=GCE, guidance_at="full").modules() if isinstance(m, GCE)]
    channels = [(b.guide_channels, b.volume_channels) for b in blocks]
    assert channels == [(GUIDES[4], 2), *3 * [(GUIDES[8], 4), (GUIDES[16], 4), (GUIDES[8], 4)]]


@pytest.mark.parametrize(
    ("in_channels", "stem", "has"), [(1, None, True), (3, None, False), (1, False, False), (3, True, True)]
)
def test_a_volume_of_one_channel_passes_a_stem(in_channels, stem, has):
    aggregation = stacked(in_channels, stem=stem)
    assert (aggregation.stem is not None) == has
    assert aggregation(torch.randn(1, in_channels, 4, 8, 8), {})[-1].shape == (1, 4, 8, 8)


@pytest.mark.parametrize(("in_channels", "before", "after"), [(1, "stem", "pair0"), (3, "pair0", "pair1")])
def test_one_guidance_acts_after_the_stem_or_the_first_pair(in_channels, before, after):
    aggregation = stacked(in_channels, guidance=GCE, guidance_at="one").eval()
    seen = {}
    for name in (before, "guidance", after):
        module = getattr(aggregation, name)
        module.register_forward_hook(lambda _, inputs, output, name=name: seen.update({name: (inputs[0], output)}))
    aggregation(torch.randn(1, in_channels, 4, 8, 8), guides_of(aggregation, (8, 8), stride=4))
    assert list(seen) == [before, "guidance", after]
    assert seen["guidance"][0] is seen[before][1]
    assert seen[after][0] is seen["guidance"][1]


def test_eval_mode_gives_the_last_head():
    aggregation = with_running_statistics(stacked())
    volume = torch.randn(1, 3, 4, 8, 8)
    heads = aggregation(volume, {})
    assert len(heads) == 3
    (best,) = aggregation.eval()(volume, {})
    assert_close(best, heads[-1])


def test_each_head_adds_to_the_one_before():
    aggregation = with_running_statistics(stacked())
    volume = torch.randn(1, 3, 4, 8, 8)
    first, second, third = aggregation(volume, {})
    assert not torch.equal(first, second)
    assert not torch.equal(second, third)
    nn.init.zeros_(aggregation.head3[-1].weight)
    assert_close(aggregation(volume, {})[2], second)
    nn.init.zeros_(aggregation.head2[-1].weight)
    assert_close(aggregation(volume, {})[2], first)


def test_hourglasses_are_residual():
    aggregation = with_running_statistics(stacked())
    hourglasses = aggregation.hourglass1, aggregation.hourglass2, aggregation.hourglass3
    entered, left, judged = [], [], []
    for hourglass in hourglasses:
        hourglass.register_forward_pre_hook(lambda _, inputs: entered.append(inputs[0]))
        hourglass.register_forward_hook(lambda _, inputs, output: left.append(output[0]))
    for head in (aggregation.head1, aggregation.head2, aggregation.head3):
        head.register_forward_pre_hook(lambda _, inputs: judged.append(inputs[0]))
    aggregation(torch.randn(1, 3, 4, 8, 8), {})
    # each adds to the volume that enters the first one
    for output, total in zip(left, judged, strict=True):
        assert_close(total, output + entered[0])
    assert entered[1] is judged[0]
    assert entered[2] is judged[1]


def test_the_second_pair_is_residual():
    assert_the_second_pair_is_residual(stacked(), torch.randn(1, 3, 4, 8, 8))


@pytest.mark.parametrize("tied", [(), ("pre",), ("post",), ("pre", "post")])
def test_one_hourglass_adds_what_it_is_given(tied):
    hourglass = stacked().eval().hourglass1
    x = torch.randn(1, 2, 4, 6, 6)
    given = {name: torch.randn(1, 4, 2, 3, 3) for name in tied}
    output, pre, post = hourglass(x, {}, **given)
    expected_pre = (hourglass.conv2(hourglass.conv1(x)) + given.get("post", 0)).relu()
    up = hourglass.conv5(hourglass.conv4(hourglass.conv3(expected_pre)))[..., :3, :3]
    expected_post = (up + given.get("pre", expected_pre)).relu()
    assert_close(pre, expected_pre)
    assert_close(post, expected_post)
    assert_close(output, hourglass.conv6(expected_post))


def test_hourglasses_are_tied_to_their_predecessors():
    aggregation = stacked().eval()
    seen = []
    for hourglass in (aggregation.hourglass1, aggregation.hourglass2, aggregation.hourglass3):
        hourglass.register_forward_hook(lambda _, inputs, output: seen.append((inputs[2:], output)))
    aggregation(torch.randn(1, 3, 4, 8, 8), {})
    (none, (_, pre1, post1)), (second, (_, _, post2)), (third, _) = seen
    assert none == ()
    assert second[0] is pre1
    assert second[1] is post1
    assert third[0] is pre1
    assert third[1] is post2


@pytest.mark.parametrize("size", [(1, 1, 1), (5, 7, 9), (8, 16, 24), (13, 3, 20)])
def test_any_size_keeps_its_size(size):
    (logits,) = stacked().eval()(torch.rand(1, 3, *size), {})
    assert logits.shape == (1, *size)


@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_gradients_are_right(guidance_at):
    aggregation = with_running_statistics(stacked(guidance=GCE, guidance_at=guidance_at).double())
    assert_gradients_are_right(aggregation, torch.randn(1, 3, 4, 8, 4), guides_of(aggregation, (8, 4), stride=4))


def test_every_weight_takes_part():
    aggregation = stacked(guidance=GCE, guidance_at="full")
    heads = aggregation(torch.randn(2, 3, 8, 8, 8), guides_of(aggregation, (8, 8), stride=4, batch=2))
    heads[-1].square().sum().backward()
    assert [name for name, p in aggregation.named_parameters() if p.grad is None] == []


def test_full_guidance_wants_every_scale():
    with pytest.raises(ConfigError, match="stride 16 wants a guide of that stride; there are guides at 4, 8"):
        StackedHourglass(in_channels=3, guidance=GCE, guidance_at="full", guide_channels=channels_at(4, 8))


def test_what_it_tells_the_network():
    aggregation = StackedHourglass(in_channels=5)
    assert (aggregation.in_channels, aggregation.multiple, aggregation.upscale) == (5, 4, 1)
    assert aggregation.loss_weights == (0.5, 0.7, 1)
