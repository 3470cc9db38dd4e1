"""What is CRL's own."""

import torch
from torch.testing import assert_close

from stereokit import build_model
from stereokit.models.crl import DispFulNet, DispResNet


def test_each_stage_has_its_published_size():
    sizes = [sum(p.numel() for p in part.parameters()) for part in (DispFulNet(max_disparity=160), DispResNet())]
    assert sizes == [42_444_413, 36_321_186]


def test_predictions_go_from_coarse_to_fine_twice():
    model = build_model("crl", max_disparity=32)
    output = model(*torch.rand(2, 1, 3, 64, 128))
    assert [p.stride for p in output.predictions] == [64, 32, 16, 8, 4, 2, 1, 16, 8, 4, 2, 1]
    assert model.auxiliary_weights == (0.2,) * 6 + (1.0,) + (0.2,) * 4


def test_without_residuals_the_first_disparity_stays():
    torch.manual_seed(0)
    second = DispResNet().eval()
    for predict in (second.predict, *(level.predict for level in second.levels)):
        torch.nn.init.zeros_(predict.weight)
        torch.nn.init.zeros_(predict.bias)
    disparity = 10 * torch.rand(1, 1, 32, 64)
    with torch.inference_mode():
        raw = second(*torch.rand(2, 1, 3, 32, 64), disparity).raw
    assert [tuple(r.shape[-2:]) for r in raw] == [(2, 4), (4, 8), (8, 16), (16, 32), (32, 64)]
    assert_close(raw[-1], disparity)
    # a mean lies within what it is of
    assert all(disparity.min() <= r.min() and r.max() <= disparity.max() for r in raw)


def test_nothing_flows_back_to_the_first_stage():
    model = build_model("crl", max_disparity=32)
    output = model(*torch.rand(2, 1, 3, 64, 64))
    output.predictions[-1].disparity.sum().backward()
    assert all(p.grad is None for p in model.first.parameters())
    assert model.second.first[0].weight.grad.abs().max() > 0


def test_disparity_is_never_negative_and_has_no_confidence():
    model = build_model("crl", max_disparity=32).eval()
    torch.nn.init.constant_(model.second.levels[-1].predict.bias, -1000.0)
    with torch.inference_mode():
        output = model(*torch.rand(2, 1, 3, 64, 64))
    assert (output.disparity == 0).all()
    assert output.confidence is None
