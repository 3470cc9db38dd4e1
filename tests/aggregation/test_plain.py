import pytest
import torch

from stereokit import GCE, PlainAggregation
from tests.aggregation.guided import (
    GUIDANCES,
    assert_gradients_are_right,
    assert_guides_matter,
    channels_at,
    guides_of,
)

GUIDES = channels_at(8)


def plain(**arguments):
    return PlainAggregation(in_channels=3, channels=4, guide_channels=GUIDES, **arguments)


@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_guidance_acts_where_it_is_placed(guidance, guidance_at):
    aggregation = plain(guidance=guidance, guidance_at=guidance_at)
    assert aggregation.guide_channels == ({} if guidance is None else GUIDES)
    volume, guides = torch.randn(2, 3, 5, 6, 7), guides_of(aggregation, (6, 7), stride=8, batch=2)
    (logits,) = aggregation(volume, guides)
    assert logits.shape == (2, 5, 6, 7)
    assert_guides_matter(aggregation, volume, guides)


@pytest.mark.parametrize(("guidance_at", "places"), [("one", 1), ("full", 4)])
def test_one_place_or_behind_each_layer(guidance_at, places):
    blocks = [m for m in plain(guidance=GCE, guidance_at=guidance_at).modules() if isinstance(m, GCE)]
    assert [(b.guide_channels, b.volume_channels) for b in blocks] == [(GUIDES[8], 4)] * places


def test_any_size_is_kept():
    assert plain().eval()(torch.rand(1, 3, 1, 5, 9), {})[0].shape == (1, 1, 5, 9)


def test_gradients_are_right():
    aggregation = plain(guidance=GCE, layers=2).eval().double()
    assert_gradients_are_right(aggregation, torch.randn(1, 3, 4, 3, 3), guides_of(aggregation, (3, 3), stride=8))
