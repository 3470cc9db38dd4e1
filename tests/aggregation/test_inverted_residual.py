import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.testing import assert_close

from stereokit import GCE, MSCA, ConfigError, InvertedResidualHourglass
from stereokit.layers import InvertedResidual
from tests.aggregation.guided import (
    GUIDANCES,
    assert_gradients_are_right,
    assert_guides_matter,
    channels_at,
    guides_of,
)
from tests.strategies import randn, seeds

GUIDES = channels_at(4, 8, 16)


def hourglass(**arguments):
    settings = {"in_channels": 1, "planes": 6, "guide_channels": GUIDES, "blocks": (1, 2, 2), **arguments}
    return InvertedResidualHourglass(**settings)


@pytest.mark.parametrize("guidance", [*GUIDANCES, MSCA])
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_guidance_acts_where_it_is_placed(guidance, guidance_at):
    aggregation = hourglass(guidance=guidance, guidance_at=guidance_at)
    wanted = {} if guidance is None else {4: GUIDES[4]} if guidance_at == "one" else GUIDES
    assert aggregation.guide_channels == wanted
    volume, guides = torch.randn(2, 1, 6, 16, 24), guides_of(aggregation, (16, 24), stride=4, batch=2)
    (logits,) = aggregation(volume, guides)
    assert logits.shape == (2, 6, 16, 24)
    assert_guides_matter(aggregation, volume, guides)


def test_full_guidance_is_three_places():
    blocks = [m for m in hourglass(guidance=GCE).modules() if isinstance(m, GCE)]
    assert [(b.guide_channels, b.volume_channels) for b in blocks] == [
        (GUIDES[4], 6),
        (GUIDES[8], 12),
        (GUIDES[16], 24),
    ]


@given(st.tuples(st.integers(1, 5), st.integers(1, 9), st.integers(1, 9)), st.integers(1, 3), seeds)
def test_any_size_keeps_its_size_and_no_logit_is_negative(size, channels, seed):
    aggregation = hourglass(planes=size[0], in_channels=channels, guide_channels=None).eval()
    (logits,) = aggregation(randn(seed, 2, channels, *size), {})
    assert logits.shape == (2, *size)
    assert (logits >= 0).all()


def test_one_channel_is_taken_as_it_is_and_several_are_joined():
    single, several = hourglass(), hourglass(in_channels=5)
    assert not any(isinstance(m, nn.Conv3d) for m in single.modules())
    assert [m.kernel_size for m in several.modules() if isinstance(m, nn.Conv3d)] == [(1, 1, 1)]
    volume = torch.randn(2, 5, 6, 8, 8)
    several.eval()
    joined = several.join(volume)
    assert_close(
        several(volume, {})[0], several.up1(several.up2(*_scales(several, joined)[:0:-1]), _scales(several, joined)[0])
    )


def _scales(aggregation, joined):
    x1 = aggregation.down1(joined[:, 0], {})
    x2 = aggregation.down2(x1, {})
    return x1, x2, aggregation.down3(x2, {})


def test_each_scale_has_its_blocks():
    aggregation = hourglass(blocks=(3, 1, 2), expansion=2)
    found = [
        [m for m in down.modules() if isinstance(m, InvertedResidual)]
        for down in (aggregation.down1, aggregation.down2, aggregation.down3)
    ]
    assert [len(blocks) for blocks in found] == [3, 1, 2]
    assert found[2][0].widen[0].out_channels == 2 * 12


def test_gradients_are_right():
    aggregation = hourglass(in_channels=2, planes=3, guidance=MSCA).double()
    guides = guides_of(aggregation, (8, 4), stride=4)
    assert_gradients_are_right(aggregation.eval(), torch.randn(1, 2, 3, 8, 4), guides)


def test_every_weight_takes_part():
    aggregation = hourglass(in_channels=2, guidance=MSCA)
    guides = guides_of(aggregation, (16, 16), stride=4, batch=2)
    aggregation(torch.randn(2, 2, 6, 16, 16), guides)[0].square().sum().backward()
    assert [name for name, p in aggregation.named_parameters() if p.grad is None] == []


@pytest.mark.parametrize("blocks", [(1, 2), (0, 1, 1), (1, 2, 3, 4)])
def test_each_of_three_scales_needs_a_block(blocks):
    with pytest.raises(ConfigError, match="one block or more for each of the three scales"):
        hourglass(blocks=blocks)
