import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError
from stereokit.contracts import Distribution, Prediction
from stereokit.layers import bin_shift
from stereokit.losses import masked_wasserstein, named_loss, neighborhood_truth, wasserstein_distance
from tests.strategies import logits, randn, seeds


def carried(points, masses, others, other_masses):
    """The least work, by carrying mass from the lowest points on."""
    heap = sorted(zip(points, masses, strict=True))
    holes = sorted(zip(others, other_masses, strict=True))
    work, i, j = 0.0, 0, 0
    left, room = heap[0][1], holes[0][1]
    while i < len(heap) and j < len(holes):
        moved = min(left, room)
        work += moved * abs(heap[i][0] - holes[j][0])
        left, room = left - moved, room - moved
        if left <= room:
            i += 1
            left = heap[i][1] if i < len(heap) else 0.0
        else:
            j += 1
            room = holes[j][1] if j < len(holes) else 0.0
    return work


def truth_for(logits, spacing, seed):
    """Truth from 0 to the last plane, one pixel in five unknown."""
    batch, levels, height, width = logits.shape
    draw = torch.rand(batch, height, width, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.where(draw < 0.2, torch.nan, draw * levels * spacing)


@given(logits(), logits(), seeds)
def test_the_distance_is_the_least_work(first, second, seed):
    batch, height, width = (min(first.shape[i], second.shape[i]) for i in (0, 2, 3))
    masses = [x[:batch, :, :height, :width].softmax(1) for x in (first, second)]
    points = [randn(seed + i, *mass.shape, dtype=torch.float64) for i, mass in enumerate(masses)]
    distance = wasserstein_distance(points[0], masses[0], points[1], masses[1])
    assert_close(distance, wasserstein_distance(points[1], masses[1], points[0], masses[0]))
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                columns = [t[b, :, y, x].tolist() for pair in zip(points, masses, strict=True) for t in pair]
                assert distance[b, y, x].item() == pytest.approx(carried(*columns), rel=1e-6, abs=1e-9)


@given(logits(), st.sampled_from([1, 2]), st.sampled_from([1.0, 2.0]), seeds)
def test_it_equals_the_loop(logits, power, spacing, seed):
    batch, levels, height, width = logits.shape
    truth = truth_for(logits, spacing, seed)
    offsets = randn(seed, *logits.shape, dtype=torch.float64)
    total, count = 0.0, 0
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                g = truth[b, y, x].item()
                if not (math.isfinite(g) and g > 0):
                    continue
                p = logits[b, :, y, x].softmax(0).tolist()
                shifts = bin_shift(offsets[b, :, y, x]).tolist()
                total += sum(p[j] * abs((j + shifts[j]) * spacing - g) ** power for j in range(levels))
                count += 1
    given = masked_wasserstein(Distribution(logits, 1, spacing, offsets=offsets), truth, power=power)
    assert given.item() == pytest.approx(total / max(count, 1), rel=1e-6, abs=1e-9)
    planes = torch.arange(levels, dtype=torch.float64) * spacing
    if levels > 1:
        of_planes = Distribution(logits, 1, 1.0, values=planes, offsets=offsets)
        assert_close(masked_wasserstein(of_planes, truth, power=power), given)


@given(logits(), seeds)
def test_both_forms_agree_about_one_point(logits, seed):
    truth = truth_for(logits, 1.0, seed)
    distribution = Distribution(logits, 1, 1.0, offsets=randn(seed, *logits.shape, dtype=torch.float64))
    known = truth.isfinite() & (truth > 0)
    point, mass = torch.where(known, truth, 0).unsqueeze(1), torch.ones_like(truth).unsqueeze(1)
    distance = wasserstein_distance(distribution.disparities(), logits.softmax(1), point, mass)
    expected = (distance * known).sum() / known.sum().clamp(min=1)
    assert_close(masked_wasserstein(distribution, truth), expected)


@given(logits(), seeds)
def test_neighbors_share_the_truth(logits, seed):
    batch, levels, height, width = logits.shape
    truth = truth_for(logits, 1.0, seed)
    known = truth.isfinite() & (truth > 0)
    _, shares = neighborhood_truth(truth, known, 0.2)
    total = 0.0
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                if not known[b, y, x]:
                    continue
                around = [
                    truth[b, v, u].item()
                    for v in range(max(y - 1, 0), min(y + 2, height))
                    for u in range(max(x - 1, 0), min(x + 2, width))
                    if (v, u) != (y, x) and known[b, v, u]
                ]
                points = [truth[b, y, x].item(), *around]
                masses = [1 - 0.025 * len(around), *(0.025 for _ in around)]
                assert sum(shares[b, :, y, x].tolist()) == pytest.approx(1)
                p = logits[b, :, y, x].softmax(0).tolist()
                total += carried(list(range(levels)), p, points, masses)
    given = masked_wasserstein(Distribution(logits, 1, 1.0), truth, neighbors=0.2)
    assert given.item() == pytest.approx(total / max(int(known.sum()), 1), rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("arguments", [{}, {"power": 2}, {"neighbors": 0.2}])
def test_gradients_are_right(arguments):
    logits, offsets = torch.randn(2, 1, 4, 2, 3, dtype=torch.float64).requires_grad_().unbind(0)
    truth = torch.tensor([[[0.7, 1.2, torch.nan], [2.6, 3.1, 0.3]]], dtype=torch.float64)

    def loss(logits, offsets):
        return masked_wasserstein(Distribution(logits, 1, 1.0, offsets=offsets), truth, **arguments)

    assert torch.autograd.gradcheck(loss, (logits, offsets))


def test_what_is_computed_anew_has_the_same_gradient():
    logits, offsets = (torch.randn(1, 4, 2, 3, requires_grad=True) for _ in range(2))
    truth = torch.rand(1, 2, 3) * 4
    distribution = Distribution(logits, 1, 1.0, offsets=offsets)
    plain = torch.autograd.grad(masked_wasserstein(distribution, truth), (logits, offsets))
    prediction = Prediction(torch.ones(1, 2, 3), 1, distribution)
    loss = named_loss("wasserstein")(prediction, truth, max_disparity=None)
    assert_close(torch.autograd.grad(loss, (logits, offsets)), plain)


def test_nothing_known_is_zero_with_a_gradient():
    logits, offsets = (torch.full((1, 4, 2, 3), torch.inf, requires_grad=True) for _ in range(2))
    loss = masked_wasserstein(Distribution(logits, 1, 1.0, offsets=offsets), torch.full((1, 2, 3), torch.nan))
    loss.backward()
    assert loss.item() == 0
    assert not logits.grad.any()


def test_what_makes_no_sense_is_refused():
    for arguments in ({"power": 3}, {"power": True}, {"neighbors": 1.0}, {"neighbors": 0.2, "power": 2}):
        with pytest.raises(ConfigError, match=next(iter(arguments))):
            named_loss({"name": "wasserstein", **arguments})
    with pytest.raises(ConfigError, match="'wasserstein' is for distributions"):
        named_loss("wasserstein")(Prediction(torch.ones(1, 2, 2)), torch.ones(1, 2, 2), max_disparity=None)
    flat = Distribution(torch.zeros(1, 4, 1, 1), 1, 1.0)
    with pytest.raises(InputError, match="power 1 or 2"):
        masked_wasserstein(flat, torch.ones(1, 1, 1), power=0)
    with pytest.raises(InputError, match="wants logits"):
        masked_wasserstein(flat, torch.ones(1, 2, 2))
