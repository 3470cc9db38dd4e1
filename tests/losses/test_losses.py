import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from torch.testing import assert_close

from stereokit import InputError, StereoOutput, build_model
from stereokit.contracts import Distribution, Features, Prediction
from stereokit.losses import masked_cross_entropy, masked_smooth_l1, named_loss, stereo_loss, truth_of_cells
from stereokit.losses.l1 import mean_of_cells
from stereokit.metrics import valid_pixels
from stereokit.registry import LOSSES
from stereokit.regression.soft_argmin import top_k_soft_argmin
from stereokit.stage import run_stage
from tests.strategies import disparities

UNKNOWN = [0.0, -3.0, math.nan, math.inf, -math.inf]
truths = hnp.arrays("float64", (1, 2, 3), elements=st.floats(0.1, 60) | st.sampled_from(UNKNOWN)).map(torch.tensor)
estimates = hnp.arrays("float64", (1, 2, 3), elements=st.floats(0, 60)).map(torch.tensor)


def loop(disparity, truth, max_disparity):
    distances = []
    for d, g in zip(disparity.flatten().tolist(), truth.flatten().tolist(), strict=True):
        if math.isfinite(g) and 0 < g < (max_disparity or math.inf):
            error = abs(d - g)
            distances.append(error - 0.5 if error >= 1 else error**2 / 2)
    return sum(distances) / max(1, len(distances))


@given(estimates, truths, st.sampled_from([None, 192, 40, 20.0]))
def test_it_equals_the_loop(disparity, truth, max_disparity):
    loss = masked_smooth_l1(disparity, truth, max_disparity=max_disparity)
    assert loss.item() == pytest.approx(loop(disparity, truth, max_disparity))


@given(estimates, truths)
def test_gradients_reach_the_known_pixels_alone(disparity, truth):
    disparity.requires_grad_()
    masked_smooth_l1(disparity, truth, max_disparity=40).backward()
    known = truth.isfinite() & (truth > 0) & (truth < 40)
    assert disparity.grad.isfinite().all()
    assert (disparity.grad[~known] == 0).all()
    # squares of distances from 1e-200 down have no gradient
    assert (disparity.grad[known & ((disparity - truth).abs() > 1e-9)] != 0).all()


@pytest.mark.parametrize("name", LOSSES.names())
@pytest.mark.parametrize("estimate", [math.inf, -math.inf, math.nan, 1e38])
@pytest.mark.parametrize("unknown", [*UNKNOWN, 192.0])
def test_what_is_estimated_where_the_truth_is_unknown_has_no_gradient(name, estimate, unknown):
    truth = torch.tensor([[[20.0, unknown, 7.0]]])
    disparity = torch.tensor([[[18.0, estimate, 8.0]]], requires_grad=True)
    logits, offsets, certainty = torch.zeros(1, 4, 1, 3), torch.full((1, 4, 1, 3), 0.1), torch.zeros(1, 1, 3)
    for part in (logits, offsets, certainty):
        part[..., 1] = estimate
        part.requires_grad_()
    head = Distribution(logits, stride=1, spacing=8, offsets=offsets, certainty=certainty)
    prediction = Prediction(disparity, 1, head, 0.25)
    loss = named_loss(name)(prediction, truth, max_disparity=192)
    loss.backward()
    assert loss.isfinite()
    gradients = [x.grad for x in (disparity, logits, offsets, certainty) if x.grad is not None]
    for gradient in gradients:
        assert gradient.isfinite().all()
        assert (gradient[..., 1] == 0).all()
        assert (gradient[..., [0, 2]] != 0).any()
    assert gradients


@pytest.mark.parametrize("unknown", [*UNKNOWN, 192.0, 500.0])
def test_no_known_pixel_is_no_loss(unknown):
    disparity = torch.rand(2, 3, 4, requires_grad=True)
    loss = masked_smooth_l1(disparity, torch.full((2, 3, 4), unknown), max_disparity=192)
    loss.backward()
    assert loss.item() == 0
    assert (disparity.grad == 0).all()


@pytest.mark.parametrize("max_disparity", [0, -1, math.inf, math.nan])
def test_a_ceiling_that_makes_no_sense_is_refused(max_disparity):
    with pytest.raises(InputError, match="max_disparity"):
        masked_smooth_l1(torch.rand(1, 2, 2), torch.rand(1, 2, 2), max_disparity=max_disparity)


@given(disparities())
def test_the_truth_has_no_loss(disparity):
    assert masked_smooth_l1(disparity, disparity.clone()).item() == 0


def test_double_truth_keeps_the_precision_of_the_estimate():
    assert masked_smooth_l1(torch.rand(1, 2, 2), torch.rand(1, 2, 2, dtype=torch.float64)).dtype == torch.float32


def test_gradients_are_right():
    disparity = torch.tensor([[[1.0, 9.0, 3.0, 3.3]]], dtype=torch.float64, requires_grad=True)
    truth = torch.tensor([[[3.0, math.nan, 0.0, 3.0]]], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda d: masked_smooth_l1(d, truth), (disparity,))


def test_shapes_that_differ_are_refused():
    with pytest.raises(InputError, match=r"\(1, 2, 3\) and \(1, 3, 2\)"):
        masked_smooth_l1(torch.rand(1, 2, 3), torch.rand(1, 3, 2))


@given(st.lists(st.tuples(st.floats(0, 5), estimates), max_size=3), estimates, truths)
def test_outputs_are_averaged_by_their_weights(auxiliary, disparity, truth):
    weights = tuple(weight for weight, _ in auxiliary)
    output = StereoOutput(disparity, tuple(Prediction(d) for d in (*(d for _, d in auxiliary), disparity)))
    loss = stereo_loss(output, truth, auxiliary_weights=weights, max_disparity=40)
    expected = loop(disparity, truth, 40) + sum(w * loop(d, truth, 40) for w, d in auxiliary)
    assert loss.item() == pytest.approx(expected / (1 + sum(weights)))


def test_weights_that_do_not_match_the_outputs_are_refused():
    output = StereoOutput(torch.rand(1, 2, 2), (Prediction(torch.rand(1, 2, 2)),) * 2)
    with pytest.raises(InputError, match="2 auxiliary weights for 1 auxiliary predictions"):
        stereo_loss(output, torch.rand(1, 2, 2), auxiliary_weights=(0.5, 0.7))


def test_it_is_exact_about_its_bounds():
    truth = torch.tensor([[[191.9, 192.0]]])
    assert_close(masked_smooth_l1(truth - 2, truth, max_disparity=192), torch.tensor(1.5))
    assert_close(masked_smooth_l1(torch.zeros(1, 1, 2), truth, max_disparity=192), torch.tensor(191.4))


STRIDE = 4
known_or_not = st.floats(0.1, 30) | st.sampled_from(UNKNOWN)
logits_and_truth = st.tuples(st.integers(1, 2), st.integers(1, 6), st.integers(1, 3), st.integers(1, 3)).flatmap(
    lambda shape: st.tuples(
        hnp.arrays("float64", shape, elements=st.floats(-9, 9)).map(torch.tensor),
        hnp.arrays("float64", (shape[0], STRIDE * shape[2], STRIDE * shape[3]), elements=known_or_not).map(
            torch.tensor
        ),
    )
)


def uniform(logits, first=0.0):
    return Distribution(logits, stride=STRIDE, spacing=STRIDE, first=first)


def cross_entropy_loop(logits, truth, first_level, max_disparity):
    entropies = []
    batch, levels, height, width = logits.shape
    for b in range(batch):
        for i in range(height):
            for j in range(width):
                g = truth[b, STRIDE * i + STRIDE // 2, STRIDE * j + STRIDE // 2].item()
                if not (math.isfinite(g) and 0 < g < (max_disparity or math.inf)):
                    continue
                position = min(max((g - first_level) / STRIDE, 0), levels - 1)
                log_mass = logits[b, :, i, j].log_softmax(0).tolist()
                shares = [max(0, 1 - abs(level - position)) for level in range(levels)]
                entropies.append(-sum(share * mass for share, mass in zip(shares, log_mass, strict=True)))
    return sum(entropies) / max(1, len(entropies))


@given(logits_and_truth, st.sampled_from([0.0, 1.5]), st.sampled_from([None, 20.0]))
def test_the_cross_entropy_equals_the_loop(given, first_level, max_disparity):
    logits, truth = given
    loss = masked_cross_entropy(uniform(logits, first_level), truth, max_disparity=max_disparity)
    expected = cross_entropy_loop(logits, truth, first_level, max_disparity)
    assert loss.item() == pytest.approx(expected, rel=1e-9, abs=1e-12)


@given(logits_and_truth, st.sampled_from([0.0, 1.5]), st.booleans())
def test_planes_that_are_listed_are_as_good_as_uniform_ones(given, first, of_each_pixel):
    logits, truth = given
    values = first + STRIDE * torch.arange(logits.shape[1], dtype=torch.float64)
    if of_each_pixel:
        values = values.reshape(1, -1, 1, 1).expand_as(logits)
    listed = masked_cross_entropy(uniform(logits)._replace(values=values), truth)
    assert listed.item() == pytest.approx(
        masked_cross_entropy(uniform(logits, first), truth).item(), rel=1e-9, abs=1e-9
    )


@given(logits_and_truth)
def test_the_gradient_of_the_cross_entropy_reaches_all_levels_of_the_known_cells_alone(given):
    logits, truth = given
    logits.requires_grad_()
    masked_cross_entropy(uniform(logits), truth).backward()
    known = valid_pixels(truth_of_cells(truth, STRIDE)).unsqueeze(1).expand_as(logits)
    assert (logits.grad[~known] == 0).all()
    # what a cell's mass is to move by, and so nothing in all
    assert_close(logits.grad.sum(1), torch.zeros_like(logits.grad[:, 0]))
    if logits.shape[1] > 2:
        assert (logits.grad[known] != 0).any() or not known.any()


@given(st.floats(0.01, 27.9), st.integers(2, 8))
def test_where_the_cross_entropy_is_least_the_regressions_give_the_truth(disparity, k):
    share = disparity / STRIDE % 1
    lower = int(disparity // STRIDE)
    mass = torch.zeros(1, 8, 1, 1, dtype=torch.float64)
    mass[0, lower], mass[0, lower + 1] = 1 - share, share
    truth = torch.full((1, STRIDE, STRIDE), disparity, dtype=torch.float64)
    least = masked_cross_entropy(uniform(mass.log()), truth)
    assert least.item() == pytest.approx(-sum(p * math.log(p) for p in (share, 1 - share) if p > 0), abs=1e-6)
    assert least <= masked_cross_entropy(uniform(mass.log() + torch.rand_like(mass)), truth) + 1e-9
    assert STRIDE * top_k_soft_argmin(mass.log(), k).item() == pytest.approx(disparity, abs=1e-6)


def test_no_known_cell_is_no_cross_entropy():
    logits = torch.rand(2, 5, 3, 4, requires_grad=True)
    loss = masked_cross_entropy(uniform(logits), torch.full((2, 12, 16), math.nan))
    loss.backward()
    assert loss.item() == 0
    assert (logits.grad == 0).all()


@given(st.integers(1, 20), st.integers(1, 20))
def test_cells_beyond_the_images_do_not_count(height, width):
    logits, truth = torch.rand(1, 4, 5, 5), torch.rand(1, height, width) * 16
    cells = truth_of_cells(truth, 4)
    other = logits.clone()
    other[:, :, cells.shape[1] :], other[:, :, :, cells.shape[2] :] = 9, -9
    assert masked_cross_entropy(uniform(logits), truth) == masked_cross_entropy(uniform(other), truth)


def test_logits_that_do_not_cover_the_truth_are_refused():
    with pytest.raises(InputError, match=r"\(1, 32, 64\) at stride 4 wants logits of at least \(1, L, 8, 16\)"):
        masked_cross_entropy(uniform(torch.rand(1, 48, 8, 15)), torch.rand(1, 32, 64))


@pytest.mark.parametrize("name", ["coex", "psmnet"])
def test_a_network_that_is_sure_of_a_level_estimates_its_disparity(name):
    model = build_model(name, max_disparity=64).eval()
    logits = torch.full((1, 64 // 4, 3, 3), -200.0)
    logits[:, 5] = 200
    # the last stage alone, with an aggregation that is sure
    model.aggregation.forward = lambda volume, guides: (logits,)
    maps = Features({4: torch.rand(1, model.backbone.info.matching_channels[4], 3, 3)}, {})
    guides = {s: torch.rand(1, c, 12 // s, 12 // s) for s, c in model.upsampler.guide_channels.items()}
    [prediction], _ = run_stage(model, maps, maps, guides, None, training=False)
    distribution = prediction.distribution
    expected = distribution.first + 5 * distribution.spacing
    middle = prediction.disparity[:, 5:7, 5:7]
    assert_close(middle, torch.full_like(middle, expected), rtol=0, atol=1e-3)
    truth = torch.full((1, 12, 12), expected)
    assert masked_cross_entropy(distribution, truth).item() == pytest.approx(0, abs=1e-6)


@given(estimates, truths, st.floats(0.1, 5))
def test_the_robust_loss_equals_the_loop(disparity, truth, scale):
    known = truth.isfinite() & (truth > 0) & (truth < 40)
    apart = (disparity - truth)[known].tolist()
    expected = sum(math.hypot(a / scale, 1) - 1 for a in apart) / max(1, len(apart))
    loss = named_loss({"name": "robust", "scale": scale})(Prediction(disparity), truth, max_disparity=40)
    assert loss.item() == pytest.approx(expected, abs=1e-12)


@given(
    hnp.arrays("float64", st.tuples(st.just(1), st.integers(1, 9), st.integers(1, 9)), elements=st.floats(-5, 60)),
    st.integers(1, 5),
)
def test_means_of_cells_equal_the_loop(values, stride):
    truth = torch.tensor(values)
    height, width = values.shape[1:]
    means, known = mean_of_cells(truth, stride, max_disparity=40)
    assert means.shape == known.shape == (1, math.ceil(height / stride), math.ceil(width / stride))
    for row, column in itertools.product(*map(range, means.shape[1:])):
        cell = truth[0, row * stride : (row + 1) * stride, column * stride : (column + 1) * stride]
        inside = cell[(cell > 0) & (cell < 40)]
        assert known[0, row, column] == bool(len(inside))
        assert means[0, row, column].item() == pytest.approx(inside.mean().item() if len(inside) else 0)
