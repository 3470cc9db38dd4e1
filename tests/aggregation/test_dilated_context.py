import pytest
import torch
from torch.testing import assert_close

from stereokit import GCE, ConfigError, DilatedContext
from tests.aggregation.guided import (
    GUIDANCES,
    assert_gradients_are_right,
    assert_guides_matter,
    channels_at,
    guides_of,
)

GUIDES = channels_at(4, 8)


def context(**arguments):
    return DilatedContext(
        **{"in_channels": 2, "planes": 3, "guide_channels": GUIDES, "channels": 4, "dilations": (1, 2)} | arguments
    )


@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_guidance_acts_where_it_is_placed(guidance, guidance_at):
    aggregation = context(guidance=guidance, guidance_at=guidance_at)
    # the guide of its scale is read with or without guidance
    assert aggregation.guide_channels == {4: GUIDES[4]}
    places = 0 if guidance is None else 1 if guidance_at == "one" else 2
    assert sum(isinstance(m, guidance or ()) for m in aggregation.modules()) == places
    volume, guides = torch.randn(2, 2, 3, 6, 7), guides_of(aggregation, (6, 7), stride=4, batch=2)
    (logits,) = aggregation(volume, guides)
    assert logits.shape == (2, 3, 6, 7)
    assert_guides_matter(aggregation, volume, guides)


def test_it_does_without_a_guide():
    aggregation = context(guide_channels=None).eval()
    assert aggregation.guide_channels == {}
    assert aggregation(torch.rand(1, 2, 3, 5, 9), {})[0].shape == (1, 3, 5, 9)


@pytest.mark.parametrize("dilations", [(1,), (3, 2), (1, 1, 2, 4, 8, 16, 1)])
def test_it_sees_as_far_as_its_dilations_reach(dilations):
    torch.manual_seed(0)
    aggregation = context(guide_channels=None, dilations=dilations).eval()
    volume = torch.randn(1, 2, 3, 3, 71)
    moved = volume.clone()
    moved[..., 35] += 1
    changed = (aggregation(volume, {})[0] != aggregation(moved, {})[0]).any(1).any(1).squeeze(0)
    assert changed[35]
    assert changed.nonzero().min() == 35 - sum(dilations)
    assert changed.nonzero().max() == 35 + sum(dilations)


def test_planes_come_ahead_of_the_guide():
    aggregation = context(dilations=(1,)).eval()
    volume, guides = torch.randn(1, 2, 3, 4, 5), {4: torch.randn(1, GUIDES[4], 4, 5)}
    stacked = torch.cat((volume.reshape(1, 6, 4, 5), guides[4]), dim=1)
    assert_close(aggregation(volume, guides)[0], aggregation.head(aggregation.layers[0](stacked)))


def test_gradients_are_right():
    aggregation = context(guidance=GCE).eval().double()
    assert_gradients_are_right(aggregation, torch.randn(1, 2, 3, 4, 4), guides_of(aggregation, (4, 4), stride=4))


@pytest.mark.parametrize("dilations", [(), (0, 1)])
def test_what_can_not_be_is_refused(dilations):
    with pytest.raises(ConfigError, match="dilations"):
        context(dilations=dilations)
