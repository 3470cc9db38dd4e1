import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError
from stereokit.contracts import Distribution, Prediction
from stereokit.losses import density_divergence, masked_cross_entropy, named_loss
from tests.strategies import logits, seeds

STRIDE = 2


def loop(logits, truth, values):
    """Cell by cell; `values` are (B, L, h, w)."""
    total, count = 0.0, 0
    for b, y, x in torch.cartesian_prod(*(torch.arange(n) for n in (len(truth), *logits.shape[2:]))).tolist():
        cell = truth[b, STRIDE * y : STRIDE * (y + 1), STRIDE * x : STRIDE * (x + 1)].flatten().tolist()
        cell = [g for g in cell if math.isfinite(g) and g > 0]
        if not cell:
            continue
        planes = values[b, :, y, x].tolist()
        g = min(max(sum(cell) / len(cell), planes[0]), planes[-1])
        p = logits[b, :, y, x].softmax(0).tolist()
        for i, plane in enumerate(planes):
            # a tent that is 1 at the plane and 0 at its neighbours
            beside = planes[i + 1] if g > plane and i + 1 < len(planes) else planes[i - 1]
            q = 1.0 if g == plane else max(0.0, 1 - abs(g - plane) / abs(beside - plane))
            total += q * math.log(q / p[i]) if q > 0 else 0
        count += 1
    return total / max(count, 1)


@st.composite
def cells(draw):
    """Distribution and truth, some of it unknown."""
    of = draw(logits(min_levels=2))
    batch, levels, height, width = of.shape
    generator = torch.Generator().manual_seed(draw(seeds))
    truth = torch.rand(batch, STRIDE * height, STRIDE * width, generator=generator, dtype=torch.float64)
    truth = torch.where(truth < 0.3, torch.nan, 1.5 * levels * STRIDE * truth)
    start = torch.rand(batch, 1, height, width, generator=generator, dtype=torch.float64) * levels
    return of, truth, STRIDE * (start + torch.arange(levels).reshape(-1, 1, 1))


@given(cells())
def test_it_equals_the_loop(given_cells):
    of, truth, values = given_cells
    found = density_divergence(Distribution(of, STRIDE, float(STRIDE), values=values), truth)
    assert math.isclose(found.item(), loop(of, truth, values), rel_tol=1e-5, abs_tol=1e-5)


@given(cells())
def test_its_gradient_is_that_of_the_cross_entropy_and_none_reaches_the_planes(given_cells):
    of, truth, values = given_cells
    # the same truth all over a cell, so that its middle is its mean
    truth = truth[:, ::STRIDE, ::STRIDE].repeat_interleave(STRIDE, 1).repeat_interleave(STRIDE, 2)
    gradients = []
    for measure in (density_divergence, masked_cross_entropy):
        x, planes = of.clone().requires_grad_(), values.clone().requires_grad_()
        measure(Distribution(x, STRIDE, float(STRIDE), values=planes), truth).backward()
        assert planes.grad is None
        gradients.append(x.grad)
    assert_close(*gradients)


@given(st.floats(0.1, 5.9))
def test_it_is_0_for_the_truth_and_above_for_all_else(g):
    mass = torch.zeros(1, 8, 1, 1, dtype=torch.float64)
    mass[0, int(g)], mass[0, int(g) + 1] = 1 - g % 1, g % 1
    truth = torch.full((1, 1, 1), g, dtype=torch.float64)
    assert density_divergence(Distribution(mass.log(), 1, 1.0), truth).item() == pytest.approx(0, abs=1e-9)
    assert density_divergence(Distribution((mass + 0.1).log(), 1, 1.0), truth) > 1e-3


def test_without_a_distribution_it_is_refused():
    with pytest.raises(ConfigError, match="density"):
        named_loss("density")(Prediction(torch.ones(1, 2, 2)), torch.ones(1, 2, 2), max_disparity=None)
