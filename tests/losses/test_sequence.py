import torch
from torch.testing import assert_close

from stereokit.contracts import Distribution, Prediction
from stereokit.losses import Sequence, masked_smooth_l1


def test_a_regression_is_held_to_smooth_l1_and_what_is_mended_to_l1():
    torch.manual_seed(0)
    estimate, truth = 3 * torch.rand(2, 1, 4, 5) + 1
    truth[:, 0] = torch.nan
    regressed = Prediction(estimate, distribution=Distribution(torch.rand(1, 2, 1, 1), 4, 4.0))
    loss = Sequence()
    assert_close(loss(regressed, truth, max_disparity=None), masked_smooth_l1(estimate, truth))
    mean = (estimate - truth)[:, 1:].abs().mean()
    assert_close(loss(Prediction(estimate), truth, max_disparity=None), mean)
    assert not torch.isclose(mean, masked_smooth_l1(estimate, truth))
