import copy

import torch
from torch import nn
from torch.testing import assert_close

from stereokit import build_model
from stereokit.optimize import prepare_for_training


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
