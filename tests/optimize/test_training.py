import copy

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.testing import assert_close

from stereokit import build_model
from stereokit.errors import ConfigError
from stereokit.optimize import copy_state, prepare_for_inference, prepare_for_training
from stereokit.optimize.training import SmallConv3d, SmallConvTranspose3d, StridedDepthwise


def test_training_goes_on_as_before():
    plain = build_model("coex", max_disparity=32).double()
    fast = prepare_for_training(copy.deepcopy(plain))
    assert_close(fast.state_dict(), plain.state_dict(), rtol=0, atol=0)
    left, right = torch.rand(2, 2, 3, 32, 64, dtype=torch.float64)
    for network in (plain, fast):
        network(left, right).disparity.mean().backward()
    for (name, ours), (_, theirs) in zip(fast.named_parameters(), plain.named_parameters(), strict=True):
        assert_close(ours.grad, theirs.grad, rtol=1e-6, atol=1e-9, msg=name)


def test_a_twin_shares_all_tensors_and_has_the_classes_to_itself():
    model = build_model("coex", max_disparity=32)
    classes, names = [type(module) for module in model.modules()], list(model.state_dict())
    tensors = dict((*model.named_parameters(), *model.named_buffers()))
    twin = prepare_for_training(model)
    assert [type(module) for module in model.modules()] == classes != [type(module) for module in twin.modules()]
    assert list(model.state_dict()) == list(twin.state_dict()) == names
    of_the_twin = dict((*twin.named_parameters(), *twin.named_buffers()))
    assert all(of_the_twin[name] is tensor for name, tensor in tensors.items())
    assert not {id(module) for module in model.modules()} & {id(module) for module in twin.modules()}
    assert all(m.weight.is_contiguous(memory_format=torch.channels_last_3d) for m in twin.modules() if is_3d(m))


def test_hooks_and_modes_stay_with_the_network():
    model = nn.Sequential(nn.Conv3d(2, 2, 3), nn.BatchNorm3d(2)).eval()
    seen = []
    hook = model[0].register_forward_hook(lambda *_: seen.append(1))
    twin = prepare_for_training(model).train()
    hook.remove()
    assert not model.training
    model(torch.rand(1, 2, 3, 3, 3))
    assert not seen
    twin(torch.rand(2, 2, 4, 4, 4))
    assert seen
    assert model[1].num_batches_tracked == 1


def test_what_moved_is_copied_back():
    model = nn.Sequential(nn.Conv2d(3, 3, 1), nn.BatchNorm2d(3))
    weight = model[0].weight
    twin = prepare_for_training(model)
    twin[1].running_var = torch.full((3,), 7.0)
    twin[0].weight = nn.Parameter(torch.ones(3, 3, 1, 1))
    copy_state(twin, model)
    assert model[0].weight is weight
    assert_close(dict(model.state_dict()), dict(twin.state_dict()), rtol=0, atol=0)


def test_a_network_that_can_not_be_copied_is_one_line():
    model = nn.Linear(2, 2)
    model.computed = model.weight * 2
    with pytest.raises(ConfigError, match="a Linear can't be copied to be made ready for training"):
        prepare_for_training(model)


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


@given(
    kind=st.sampled_from([nn.Conv3d, nn.ConvTranspose3d]),
    kernel=st.integers(2, 4),
    stride=st.integers(1, 2),
    size=st.tuples(*[st.integers(1, 5)] * 3),
    seed=st.integers(0, 2**32 - 1),
)
def test_autocast_leaves_volumes_smaller_than_the_kernel_in_float32(kind, kernel, stride, size, seed):
    torch.manual_seed(seed)
    # of whole numbers, whose products are exact in float32
    padding = kernel // 2 if kind is nn.Conv3d else (kernel - 1) // 2
    conv = kind(3, 4, kernel, stride=stride, padding=padding, bias=False)
    with torch.no_grad():
        conv.weight.copy_(torch.randint(-8, 9, conv.weight.shape))
    volume = torch.randint(-8, 9, (1, 3, *size)).float()
    expected = conv(volume)
    direction = torch.randint(-8, 9, expected.shape).float()
    (wanted,) = torch.autograd.grad(expected, conv.weight, direction)
    fast = prepare_for_training(nn.Sequential(conv))
    with torch.autocast("cpu", torch.bfloat16):
        y = fast(volume)
    (gradient,) = torch.autograd.grad(y, conv.weight, direction.bfloat16())
    assert y.dtype == torch.bfloat16
    if min(size) < kernel:
        assert_close(y, expected.bfloat16(), rtol=0, atol=0)
        assert_close(gradient, wanted, rtol=0, atol=0)
    else:
        assert_close(gradient, wanted, rtol=0.01, atol=0)


def test_transposed_convolutions_take_the_size_of_their_output():
    fast = prepare_for_training(nn.ConvTranspose3d(2, 2, 3, stride=2, padding=1))
    with torch.autocast("cpu", torch.bfloat16):
        for depth in (2, 3):
            size = [2 * depth, 8, 7]
            assert fast(torch.rand(1, 2, depth, 4, 4), output_size=size).shape[2:] == tuple(size)


def test_weights_of_half_precision_work_in_autocast():
    fast = prepare_for_training(nn.Conv2d(4, 4, 3, stride=2, groups=4).bfloat16())
    with torch.autocast("cpu", torch.bfloat16):
        assert fast(torch.rand(1, 4, 6, 6)).dtype == torch.bfloat16


def test_other_convolutions_stay_what_they_are():
    kinds = [nn.Conv2d(8, 8, 3, groups=8), nn.Conv2d(8, 8, 3, stride=2), nn.Conv2d(8, 8, 3, stride=2, groups=2)]
    assert all(type(module) is nn.Conv2d for module in prepare_for_training(nn.Sequential(*kinds)))


def test_networks_that_were_trained_are_prepared_for_inference():
    model = prepare_for_training(build_model("coex", max_disparity=32)).eval()
    substitutes = {StridedDepthwise, SmallConv3d, SmallConvTranspose3d}
    assert {type(module) for module in model.modules()} >= substitutes
    assert not {type(module) for module in prepare_for_inference(model).modules()} & substitutes
