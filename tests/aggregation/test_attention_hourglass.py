import pytest
import torch
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import GCE, AttentionHourglass
from tests.aggregation.guided import (
    GUIDANCES,
    assert_gradients_are_right,
    assert_guides_matter,
    channels_at,
    guides_of,
)

GUIDES = channels_at(8, 16, 32)


def attention(**arguments):
    return AttentionHourglass(in_channels=2, channels=(3, 4), guide_channels=GUIDES, **arguments)


@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_guidance_acts_where_it_is_placed(guidance, guidance_at):
    aggregation = attention(guidance=guidance, guidance_at=guidance_at)
    wanted = {} if guidance is None else {8: GUIDES[8]} if guidance_at == "one" else GUIDES
    assert aggregation.guide_channels == wanted
    volume, guides = torch.randn(2, 2, 4, 8, 12), guides_of(aggregation, (8, 12), stride=8, batch=2)
    (logits,) = aggregation(volume, guides)
    assert logits.shape == (2, 8, 16, 24)
    assert_guides_matter(aggregation, volume, guides)


def test_full_guidance_is_four_places():
    blocks = [m for m in attention(guidance=GCE, guidance_at="full").modules() if isinstance(m, GCE)]
    assert [(b.guide_channels, b.volume_channels) for b in blocks] == [
        (GUIDES[8], 2),
        (GUIDES[16], 3),
        (GUIDES[32], 4),
        (GUIDES[16], 3),
    ]


@pytest.mark.parametrize("size", [(1, 1, 1), (5, 7, 9), (4, 8, 12)])
def test_logits_are_twice_as_fine(size):
    (logits,) = attention().eval()(torch.rand(1, 2, *size), {})
    assert logits.shape == (1, *(2 * n for n in size))


def test_planes_and_channels_are_smoothed_apart():
    aggregation, volume = attention(), torch.randn(1, 2, 4, 8, 8)
    smooth = aggregation.smooth(volume)
    for c in range(2):
        for d in range(4):
            alone = F.conv2d(volume[:, c : c + 1, d], aggregation.smooth.weight[c : c + 1, :, 0], padding=1)
            assert_close(smooth[:, c, d], alone[:, 0])


@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_gradients_are_right(guidance_at):
    aggregation = attention(guidance=GCE, guidance_at=guidance_at).double().eval()
    assert_gradients_are_right(aggregation, torch.randn(1, 2, 4, 4, 4), guides_of(aggregation, (4, 4), stride=8))
