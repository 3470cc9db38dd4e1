import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import GCE, ConfigError, SeparableHourglass
from tests.aggregation.guided import (
    GUIDANCES,
    assert_gradients_are_right,
    assert_guides_matter,
    channels_at,
    guides_of,
    with_running_statistics,
)

GUIDES = channels_at(4, 8, 16)
every_kind = pytest.mark.parametrize("dims", [2, 3])


def separable(dims, in_channels=3, planes=4, **arguments):
    return SeparableHourglass(
        in_channels=in_channels, planes=planes, channels=2, dims=dims, guide_channels=GUIDES, **arguments
    )


@every_kind
@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_guidance_acts_where_it_is_placed(dims, guidance, guidance_at):
    aggregation = separable(dims, planes=8, guidance=guidance, guidance_at=guidance_at)
    wanted = {} if guidance is None else {4: GUIDES[4]} if guidance_at == "one" else GUIDES
    assert aggregation.guide_channels == wanted
    volume, guides = torch.randn(2, 3, 8, 8, 12), guides_of(aggregation, (8, 12), stride=4, batch=2)
    assert [logits.shape for logits in aggregation(volume, guides)] == 4 * [(2, 8, 8, 12)]
    assert_guides_matter(aggregation, volume, guides)


@every_kind
def test_eval_mode_gives_the_last_head(dims):
    aggregation, volume = with_running_statistics(separable(dims)), torch.randn(1, 3, 4, 8, 8)
    heads = aggregation(volume, {})
    (best,) = aggregation.eval()(volume, {})
    assert_close(best, heads[-1])


def test_the_second_pair_is_residual():
    aggregation, volume, entered = separable(3).eval(), torch.randn(1, 3, 4, 8, 8), []
    nn.init.zeros_(aggregation.pair1[1].narrow[1].weight)
    aggregation.hourglass1.register_forward_pre_hook(lambda _, inputs: entered.append(inputs[0]))
    aggregation(volume, {})
    assert_close(entered[0], aggregation.pair0(volume))


@every_kind
def test_one_hourglass_skips_by_inverted_residuals(dims):
    hourglass = separable(dims, planes=3).eval().hourglass1
    x = torch.randn(1, 3, 6, 6) if dims == 2 else torch.randn(1, 2, 4, 6, 6)
    half = hourglass.conv2(hourglass.conv1(x))
    up = hourglass.conv5(hourglass.conv4(hourglass.conv3(half)))[..., :3, :3]
    up = (up + hourglass.skip2(half)).relu()
    assert_close(hourglass(x, {}), (hourglass.conv6(up) + hourglass.skip1(x)).relu())


@pytest.mark.parametrize(("dims", "residual", "adds"), [(2, None, True), (3, None, False), (3, True, True)])
def test_blocks_add_their_input_where_it_was_published(dims, residual, adds):
    aggregation = separable(dims, residual=residual)
    assert {aggregation.pair1[0].adds_input, aggregation.hourglass2.conv4.adds_input} == {adds}
    assert not aggregation.hourglass2.conv3.adds_input


@every_kind
@pytest.mark.parametrize("size", [(1, 1), (7, 9), (16, 24)])
def test_any_size_keeps_its_size(dims, size):
    (logits,) = separable(dims, planes=5).eval()(torch.rand(1, 3, 5, *size), {})
    assert logits.shape == (1, 5, *size)


@every_kind
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_gradients_are_right(dims, guidance_at):
    aggregation = with_running_statistics(separable(dims, guidance=GCE, guidance_at=guidance_at).double())
    assert_gradients_are_right(aggregation, torch.randn(1, 3, 4, 8, 4), guides_of(aggregation, (8, 4), stride=4))


def test_hourglasses_are_of_the_published_size():
    sizes = {
        dims: sum(p.numel() for p in SeparableHourglass(in_channels=1, planes=48, dims=dims).hourglass1.parameters())
        for dims in (2, 3)
    }
    assert sizes == {2: 523_584, 3: 434_560}


def test_other_dimensions_are_refused():
    with pytest.raises(ConfigError, match="use 2 or 3"):
        separable(1)
