import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import ConfigError, DisparityRange, NeighborhoodRange, UniformCandidates
from stereokit.contracts import Prediction
from tests.strategies import seeds


def disparity(seed, height=12, width=16, largest=200.0):
    return largest * torch.rand((1, height, width), generator=torch.Generator().manual_seed(seed))


def published_loop(before, count, spacing, max_disparity):
    """In quarter pixels, cell by cell, as the published code has it."""
    quarter = F.interpolate(before.unsqueeze(1) / 4, scale_factor=0.25, mode="bilinear")[0, 0]
    rows, columns = quarter.shape
    samples = torch.empty(count // 4, rows, columns)
    for y in range(rows):
        for x in range(columns):
            near = quarter[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
            low, high = near.min(), near.max()
            pad = max(count / 4 * spacing - (high - low).item(), 0) / 2
            low, high = (low - pad).clamp(0, max_disparity), (high + pad).clamp(0, max_disparity)
            samples[:, y, x] = torch.linspace(low.item(), high.item(), count // 4)
    return F.interpolate(4 * samples[None, None], (count, *before.shape[1:]), mode="trilinear")[0]


@given(seeds, st.sampled_from([(24, 1.0), (12, 0.5), (8, 30.0)]))
def test_the_published_form_equals_the_loop(seed, planes):
    before, (count, spacing) = disparity(seed), planes
    sampler = NeighborhoodRange(stride=2, max_disparity=192, planes=count, spacing=spacing, published=True)
    values = sampler(None, None, Prediction(before)).values
    assert_close(values, published_loop(before, count, spacing, 192), rtol=1e-5, atol=1e-3)
    assert_close(values[:, 0], values[:, 1])


@given(seeds, st.floats(0.0, 250.0))
def test_candidates_rise_within_the_range(seed, largest):
    before = disparity(seed, largest=largest)
    values = NeighborhoodRange(stride=2, max_disparity=192)(None, None, Prediction(before)).values
    assert values.shape == (1, 24, 12, 16)
    assert values.min() >= 0
    assert values.max() <= 192
    assert (values.diff(dim=1) >= -1e-4).all()


@given(st.floats(15.0, 170.0))
def test_around_a_plane_they_are_evenly_spread(middle):
    values = NeighborhoodRange(stride=2, max_disparity=192)(None, None, Prediction(torch.full((1, 8, 8), middle)))
    expected = (middle + torch.linspace(-12, 12, 24)).reshape(1, -1, 1, 1).expand(1, 24, 8, 8)
    assert_close(values.values, expected, rtol=1e-4, atol=1e-3)


@given(seeds)
def test_the_plain_range_is_of_each_pixel_alone(seed):
    before = disparity(seed)
    values = DisparityRange(stride=2, planes=24)(None, None, Prediction(before)).values
    assert_close(values.mean(1), before, rtol=1e-5, atol=1e-4)
    assert_close(values[:, -1] - values[:, 0], torch.full_like(before, 24.0), rtol=1e-4, atol=1e-3)


def test_there_has_to_be_a_stage_before():
    for sampler in (DisparityRange(stride=2), NeighborhoodRange(stride=2, max_disparity=192)):
        assert (sampler.planes, sampler.fixed) == (12, False)
        with pytest.raises(ConfigError, match="behind a coarse stage"):
            sampler(None, None, None)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"planes": 1}, "planes=1"),
        ({"planes": 23}, "planes=23"),
        ({"spacing": 0}, "spacing=0"),
        ({"window": 2}, "window=2"),
        ({"cell": 0}, "cell=0"),
        ({"cell": 5, "published": True}, "cell=5"),
    ],
)
def test_what_makes_no_range_is_refused(arguments, words):
    with pytest.raises(ConfigError, match=words):
        NeighborhoodRange(stride=2, max_disparity=192, **arguments)


@pytest.mark.parametrize(
    ("arguments", "planes", "count", "fixed"),
    [({}, 48, None, True), ({"per_plane": 4}, 12, 48, False), ({"include_end": True, "spacing": 3.0}, 65, 65, False)],
)
def test_uniform_candidates_fill_their_planes(arguments, planes, count, fixed):
    sampler = UniformCandidates(max_disparity=192, stride=4, **arguments)
    values = sampler(None, None, None).values
    assert (sampler.planes, sampler.fixed) == (planes, fixed)
    assert (None if values is None else values.numel()) == count
    if count:
        assert_close(values, sampler.spacing * torch.arange(count))
