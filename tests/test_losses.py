import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from torch.testing import assert_close

from stereokit import InputError, StereoOutput
from stereokit.losses import masked_smooth_l1, stereo_loss
from tests.strategies import disparities

UNKNOWN = [0.0, -3.0, math.nan, math.inf, -math.inf]
truths = hnp.arrays("float64", (1, 2, 3), elements=st.floats(0.1, 60) | st.sampled_from(UNKNOWN)).map(torch.tensor)
estimates = hnp.arrays("float64", (1, 2, 3), elements=st.floats(0, 60)).map(torch.tensor)


def loop(disparity, truth, max_disparity):
    distances = []
    for d, g in zip(disparity.flatten().tolist(), truth.flatten().tolist(), strict=True):
        if math.isfinite(g) and 0 < g < max_disparity:
            error = abs(d - g)
            distances.append(error - 0.5 if error >= 1 else error**2 / 2)
    return sum(distances) / max(1, len(distances))


@given(estimates, truths, st.sampled_from([math.inf, 192, 40, 20.0]))
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


@pytest.mark.parametrize("unknown", [*UNKNOWN, 192.0, 500.0])
def test_no_known_pixel_is_no_loss(unknown):
    disparity = torch.rand(2, 3, 4, requires_grad=True)
    loss = masked_smooth_l1(disparity, torch.full((2, 3, 4), unknown), max_disparity=192)
    loss.backward()
    assert loss.item() == 0
    assert (disparity.grad == 0).all()


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
    output = StereoOutput(disparity, auxiliary=tuple(d for _, d in auxiliary))
    loss = stereo_loss(output, truth, auxiliary_weights=weights, max_disparity=40)
    expected = loop(disparity, truth, 40) + sum(w * loop(d, truth, 40) for w, d in auxiliary)
    assert loss.item() == pytest.approx(expected / (1 + sum(weights)))


def test_weights_that_do_not_match_the_outputs_are_refused():
    output = StereoOutput(torch.rand(1, 2, 2), auxiliary=(torch.rand(1, 2, 2),))
    with pytest.raises(InputError, match="2 auxiliary weights for 1 auxiliary disparities"):
        stereo_loss(output, torch.rand(1, 2, 2), auxiliary_weights=(0.5, 0.7))


def test_it_is_exact_about_its_bounds():
    truth = torch.tensor([[[191.9, 192.0]]])
    assert_close(masked_smooth_l1(truth - 2, truth, max_disparity=192), torch.tensor(1.5))
    assert_close(masked_smooth_l1(torch.zeros(1, 1, 2), truth, max_disparity=192), torch.tensor(191.4))
