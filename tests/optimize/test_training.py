import copy

import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.testing import assert_close

from stereokit import build_model
from stereokit.optimize import prepare_for_inference, prepare_for_training
from stereokit.optimize.training import StridedDepthwise


def test_training_goes_on_as_before():
    plain = build_model("coex", max_disparity=32).double()
    fast = prepare_for_training(copy.deepcopy(plain))
    assert_close(fast.state_dict(), plain.state_dict(), rtol=0, atol=0)
    left, right = torch.rand(2, 2, 3, 32, 64, dtype=torch.float64)
    for network in (plain, fast):
        network(left, right).disparity.mean().backward()
    for (name, ours), (_, theirs) in zip(fast.named_parameters(), plain.named_parameters(), strict=True):
        assert_close(ours.grad, theirs.grad, rtol=1e-6, atol=1e-9, msg=name)


def test_formats_are_set_in_place():
    model = build_model("coex", max_disparity=32)
    weights = [id(parameter) for parameter in model.parameters()]
    assert prepare_for_training(model) is model
    assert [id(parameter) for parameter in model.parameters()] == weights
    assert all(m.weight.is_contiguous(memory_format=torch.channels_last_3d) for m in model.modules() if is_3d(m))


def is_3d(module):
    return isinstance(module, nn.Conv3d | nn.ConvTranspose3d)


@given(stride=st.sampled_from([2, (1, 2), (2, 1)]), channels=st.integers(2, 9))
def test_autocast_leaves_strided_depthwise_convolutions_in_float32(stride, channels):
    conv = nn.Conv2d(channels, channels, (1, 2), stride=stride, groups=channels, bias=False)
    fast = prepare_for_training(nn.Sequential(conv))
    x = torch.ones(1, channels, 6, 10, dtype=torch.bfloat16)
    with torch.no_grad():
        # in bfloat16 the two cancel out
        conv.weight[..., 0], conv.weight[..., 1] = 1 + 2**-10, -1
    with torch.autocast("cpu", torch.bfloat16):
        y = fast(x)
    assert y.dtype == torch.bfloat16
    assert (y == 2**-10).all()
    assert (fast(x.float()) == 2**-10).all()


def test_weights_of_half_precision_work_in_autocast():
    fast = prepare_for_training(nn.Conv2d(4, 4, 3, stride=2, groups=4).bfloat16())
    with torch.autocast("cpu", torch.bfloat16):
        assert fast(torch.rand(1, 4, 6, 6)).dtype == torch.bfloat16


def test_other_convolutions_stay_what_they_are():
    kinds = [nn.Conv2d(8, 8, 3, groups=8), nn.Conv2d(8, 8, 3, stride=2), nn.Conv2d(8, 8, 3, stride=2, groups=2)]
    assert all(type(module) is nn.Conv2d for module in prepare_for_training(nn.Sequential(*kinds)))


def test_networks_that_were_trained_are_prepared_for_inference():
    model = prepare_for_training(build_model("coex", max_disparity=32)).eval()
    assert any(type(module) is StridedDepthwise for module in model.modules())
    assert not any(type(module) is StridedDepthwise for module in prepare_for_inference(model).modules())
