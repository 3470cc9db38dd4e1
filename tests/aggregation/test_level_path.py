import pytest
import torch

from stereokit import GCE, LevelPathAggregation
from tests.aggregation.guided import (
    GUIDANCES,
    assert_gradients_are_right,
    assert_guides_matter,
    channels_at,
    guides_of,
)

GUIDES = channels_at(3, 6, 12)


def path(levels=(1, 2, 1, 0, 1), **arguments):
    return LevelPathAggregation(
        in_channels=3, filters=1, levels=levels, skips=[(0, 2)], guide_channels=GUIDES, **arguments
    )


@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_guidance_acts_where_it_is_placed(guidance, guidance_at):
    aggregation = path(guidance=guidance, guidance_at=guidance_at)
    wanted = {} if guidance is None else {3: GUIDES[3]} if guidance_at == "one" else GUIDES
    assert aggregation.guide_channels == wanted
    volume, guides = torch.randn(2, 3, 8, 8, 12), guides_of(aggregation, (8, 12), stride=3, batch=2)
    (logits,) = aggregation(volume, guides)
    assert logits.shape == (2, 8, 8, 12)
    assert_guides_matter(aggregation, volume, guides)


def test_full_guidance_is_behind_the_first_convolution_and_each_cell():
    blocks = [m for m in path(guidance=GCE, guidance_at="full").modules() if isinstance(m, GCE)]
    assert [b.volume_channels for b in blocks] == [4, 8, 16, 8, 4, 8]


@pytest.mark.parametrize("levels", [(0, 0, 0, 1, 0), (1, 1, 1, 1, 2)])
@pytest.mark.parametrize("size", [(1, 2, 3), (5, 7, 9), (8, 16, 8)])
def test_any_size_is_kept_wherever_the_path_ends(levels, size):
    assert path(levels).eval()(torch.rand(1, 3, *size), {})[0].shape == (1, *size)


def test_it_has_the_size_of_the_published_one():
    # less the norm of its last convolution and what the ladder does not use
    aggregation = LevelPathAggregation(in_channels=64)
    assert sum(p.numel() for p in aggregation.parameters()) == 1_709_986 - 2 - 8_320 - 33_024


def test_gradients_are_right():
    aggregation = path(levels=(1, 0, 1, 0), guidance=GCE).eval().double()
    assert_gradients_are_right(aggregation, torch.randn(1, 3, 4, 4, 4), guides_of(aggregation, (4, 4), stride=3))
