import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import GCE, ConfigError
from stereokit.guidance import GuidancePlan, GuidancePoint, NoGuidance


def test_no_guidance_leaves_the_volume():
    volume = torch.rand(1, 2, 3, 4, 5)
    assert NoGuidance()(volume) is volume
    assert NoGuidance(guide_channels=3, volume_channels=2)(volume, torch.rand(1, 3, 4, 5)) is volume


def test_a_point_hands_its_block_the_guide_of_its_stride():
    point = GuidancePoint(GCE, stride=8, guide_channels={4: 3, 8: 5}, volume_channels=2).eval()
    volume, guides = torch.rand(1, 2, 3, 4, 5), {4: torch.rand(1, 3, 8, 10), 8: torch.rand(1, 5, 4, 5)}
    assert point.guide_channels == {8: 5}
    assert_close(point(volume, guides), point.block(volume, guides[8]))


def test_a_point_without_guidance_reads_no_guide():
    point = GuidancePoint(None, stride=8, guide_channels={}, volume_channels=2)
    volume = torch.rand(1, 2, 3, 4, 5)
    assert point(volume, {}) is volume
    assert point.guide_channels == {}
    assert not list(point.parameters())


@pytest.mark.parametrize(("guides", "listed"), [({4: 3, 16: 5}, "4, 16"), ({}, "none")])
def test_a_point_wants_a_guide_of_its_stride(guides, listed):
    with pytest.raises(ConfigError, match=f"stride 8 wants a guide of that stride; there are guides at {listed}"):
        GuidancePoint(GCE, stride=8, guide_channels=guides, volume_channels=2)


@pytest.mark.parametrize(
    ("guidance", "placement", "first", "further"),
    [
        (GCE, "one", {4: 3}, {}),
        (GCE, "full", {4: 3}, {8: 5}),
        (None, "one", {}, {}),
        (None, "full", {}, {}),
    ],
)
def test_a_plan_places_guidance(guidance, placement, first, further):
    plan = GuidancePlan(guidance, placement, stride=4, guide_channels={4: 3, 8: 5})
    points = nn.ModuleList([plan.first(2), plan.at(2, 6)])
    assert points[0].guide_channels == first
    assert points[1].guide_channels == further
    assert GuidancePlan.guides_read_by(points) == {**first, **further}
    assert [isinstance(p.block, GCE) for p in points] == [bool(first), bool(further)]


def test_blocks_get_the_channels_of_their_place():
    plan = GuidancePlan(GCE, "full", stride=4, guide_channels={4: 3, 8: 5})
    block = plan.at(2, 6).block
    assert (block.guide_channels, block.volume_channels) == (5, 6)


@pytest.mark.parametrize("placement", ["none", "all", "", None])
def test_other_placements_are_refused(placement):
    with pytest.raises(ConfigError, match=r"is not a placement; use 'one' or 'full', or guidance='none'"):
        GuidancePlan(GCE, placement, stride=4, guide_channels={4: 3})


def test_guidance_without_guides_is_refused():
    with pytest.raises(ConfigError, match="stride 4 wants a guide"):
        GuidancePlan(GCE, "one", stride=4, guide_channels=None).first(2)
