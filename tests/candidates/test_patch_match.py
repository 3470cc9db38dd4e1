import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError
from stereokit.candidates import PatchMatch, patch_match
from stereokit.candidates.patch_match import scattered, whole_with_ends
from stereokit.contracts import Features
from tests.strategies import seeds


def maps(seed, shape=(2, 4, 3, 7), scale=1.0):
    return scale * torch.randn(2, *shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def noise_of(seed, shape):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)


def loop(left, right, noise, planes, iterations, sharpness):
    """The equation, pixel by pixel."""
    batch, channels, height, width = left.shape
    particles = noise.shape[1]
    places = noise.expand(batch, -1, -1, -1).clone().float()
    for _ in range(iterations):
        for dy, dx in ((0, 1), (1, 0)):
            new = torch.empty_like(places)
            for b in range(batch):
                for i in range(particles):
                    for y in range(height):
                        for x in range(width):
                            offers, scores = [], []
                            for k in (-1, 0, 1):
                                at = (y + k * dy, x + k * dx)
                                inside = 0 <= at[0] < height and 0 <= at[1] < width
                                place = places[b, i, at[0], at[1]].item() if inside else 0.0
                                d = math.floor((i + place) * planes / particles)
                                partner = max(x - min(d, planes - 1), 0)
                                scores.append((left[b, :, y, x] * right[b, :, y, partner]).sum() / channels)
                                offers.append(place)
                            weights = (sharpness * torch.stack(scores)).softmax(0)
                            new[b, i, y, x] = (weights * torch.tensor(offers)).sum()
            places = new
    return (torch.arange(particles).reshape(-1, 1, 1) + places) * planes / particles


@given(seeds, st.integers(1, 3), st.integers(1, 2), st.sampled_from([1.0, 7.0]))
def test_it_equals_the_loop(seed, particles, iterations, sharpness):
    left, right = maps(seed, (1, 4, 3, 5))
    noise = noise_of(seed, (1, particles, 3, 5))
    given_ = patch_match(left, right, noise, 6, iterations=iterations, sharpness=sharpness)
    expected = loop(left, right, noise, 6, iterations, sharpness)
    # a place may fall on the other side of a whole disparity by rounding: then its weights are others
    assert ((given_ - expected).abs() < 1e-4).float().mean() > 0.9


@given(seeds, st.integers(1, 6))
def test_each_particle_stays_in_its_part_of_the_range(seed, particles):
    left, right = maps(seed, scale=3.0)
    found = patch_match(left, right, noise_of(seed, (2, particles, 3, 7)), 12)
    part = torch.arange(particles).reshape(-1, 1, 1) * 12 / particles
    assert found.shape == (2, particles, 3, 7)
    assert (found >= part - 1e-5).all()
    assert (found <= part + 12 / particles + 1e-5).all()
    assert (found.diff(dim=1) >= -1e-5).all()


@given(seeds)
def test_pairs_of_a_batch_do_not_see_each_other(seed):
    left, right = maps(seed)
    noise = noise_of(seed, (1, 3, 3, 7))
    both = patch_match(left, right, noise, 6)
    assert_close(both[1:], patch_match(left[1:], right[1:], noise, 6))


def test_neighbours_spread_what_matches():
    """Features that match at 5 px alone: the particle of that part comes to it from random places."""
    torch.manual_seed(0)
    right = torch.nn.functional.normalize(torch.randn(1, 64, 24, 64), dim=1) * 16
    left = right.roll(5, -1)
    found = patch_match(left, right, torch.rand(1, 2, 24, 64), 16, iterations=4)[0, 0, :, 12:-2]
    assert (found.floor() == 5).float().mean() > 0.95
    first = torch.rand(1, 2, 24, 64)[0, 0] * 8
    assert (first.floor() == 5).float().mean() < 0.2


@given(seeds)
def test_candidates_are_whole_and_end_next_to_what_was_found(seed):
    found = noise_of(seed, (1, 4, 3, 5)).sort(dim=1).values * 12
    whole = whole_with_ends(found, 12)
    assert whole.shape == (1, 6, 3, 5)
    assert_close(whole, whole.round())
    assert (whole.diff(dim=1) >= 0).all()
    assert (whole[:, 0] <= found[:, 0]).all()
    assert (whole[:, -1] >= found[:, -1]).all()
    assert (whole[:, -1] - found[:, -1] < 1).all()


def test_in_eval_mode_a_pair_has_one_result_and_in_training_mode_many():
    sampler = PatchMatch(stride=4, max_disparity=64)
    views = [Features({4: m.float()}, {}) for m in maps(0, (1, 4, 8, 12))]
    assert torch.equal(sampler.eval()(*views, None).values, sampler(*views, None).values)
    sampler.train()
    torch.manual_seed(0)
    one, other = sampler(*views, None).values, sampler(*views, None).values
    assert not torch.equal(one, other)
    torch.manual_seed(0)
    assert torch.equal(sampler(*views, None).values, one)


def test_scattered_numbers_fill_the_unit_interval_in_every_patch():
    u = scattered(12, 32, 32, like=torch.zeros(()))
    assert ((u >= 0) & (u < 1)).all()
    for part in u.unfold(2, 8, 8).unfold(3, 8, 8).reshape(12 * 16, 64):
        counts = torch.histc(part, 4, 0, 1)
        assert counts.min() >= 10


def test_candidates_are_in_pixels_of_the_image():
    sampler = PatchMatch(stride=8, max_disparity=128)
    views = [Features({8: m.float()}, {}) for m in maps(0, (1, 4, 8, 12))]
    values = sampler.eval()(*views, None).values
    assert values.shape == (1, 14, 8, 12)
    assert (values % 8 == 0).all()
    assert values.max() > 64
    assert values.max() <= 128


@pytest.mark.parametrize(
    "arguments", [{"particles": 17}, {"particles": 0}, {"iterations": 0}, {"sharpness": 0.0}, {"sharpness": math.nan}]
)
def test_what_leaves_no_candidates_is_refused(arguments):
    with pytest.raises(ConfigError, match="patch_match"):
        PatchMatch(stride=4, max_disparity=64, **arguments)


@pytest.mark.parametrize("shape", [(3, 2, 3, 7), (1, 2, 3, 6), (1, 7, 3, 7)])
def test_noise_of_another_size_is_refused(shape):
    left, right = maps(0)
    with pytest.raises(InputError, match=r"noise|particles"):
        patch_match(left, right, torch.zeros(shape), 6)
