import copy
import warnings

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from stereokit import ConfigError, StereoOutput, build_model
from stereokit.optimize import PreparedNetwork, prepare_for_inference
from stereokit.optimize.convolution import FusedConvolution
from tests.optimize.networks import off, settle, settled

# further networks are held to `tests/models/cases.py`
every_model = pytest.mark.parametrize("name", ["coex", "psmnet", "gcnet"])


@every_model
@pytest.mark.parametrize(("height", "width"), [(64, 96), (45, 77)])
def test_results_stay(name, height, width):
    plain = settled(name)
    fast = prepare_for_inference(plain)
    difference = off(fast, plain, height, width)
    assert difference.quantile(0.999) < 1e-3
    assert difference.shape == (1, height, width)


@pytest.mark.parametrize(
    "overrides",
    [
        {"guidance": "neighborhood", "guidance_at": "one", "upsampler": "bilinear"},
        {"backbone": "resnet18", "cost": "concatenation", "guidance": "addition"},
        {"backbone": "mobilenetv3_large_100", "cost": {"name": "groupwise_correlation", "groups": 4}},
        {"backbone": "efficientnet_b0", "aggregation": "stacked_hourglass", "top_k": 8},
    ],
)
def test_results_stay_whatever_the_blocks(overrides):
    # in double precision, as roundings grow in random networks that are deep
    plain = settled("coex", **overrides).double()
    left, right = torch.rand(2, 1, 3, 64, 96)
    with torch.inference_mode():
        assert_close(prepare_for_inference(plain)(left, right), plain(left, right), rtol=1e-7, atol=1e-7)


@every_model
def test_everything_known_is_fused(name):
    fast = prepare_for_inference(build_model(name, max_disparity=32))
    kinds = (nn.Conv2d, nn.Conv3d, nn.ConvTranspose2d, nn.ConvTranspose3d, nn.BatchNorm2d, nn.BatchNorm3d)
    assert [path for path, module in fast.named_modules() if isinstance(module, (*kinds, nn.LeakyReLU, nn.ReLU))] == []
    assert any(isinstance(module, FusedConvolution) for module in fast.modules())


@every_model
def test_the_original_is_not_touched(name):
    model = build_model(name, max_disparity=32).train()
    kinds = [type(m) for m in model.modules()]
    state = copy.deepcopy(model.state_dict())
    fast = prepare_for_inference(model)
    assert model.training
    assert [type(m) for m in model.modules()] == kinds
    assert all(p.requires_grad for p in model.parameters())
    assert not any(m._forward_hooks or m._forward_pre_hooks for m in model.modules())
    assert_close(model.state_dict(), state, rtol=0, atol=0)
    shared = {t.data_ptr() for t in model.state_dict().values()} & {t.data_ptr() for t in fast.state_dict().values()}
    assert shared <= {0}
    assert not any(t.requires_grad for t in fast.parameters())


def test_a_network_in_training_mode_is_prepared_in_eval_mode():
    plain = settled("coex")
    fast = prepare_for_inference(plain.train())
    assert not any(m.training for m in fast.modules())
    assert off(fast, plain.eval(), 64, 64).quantile(0.999) < 1e-3
    fast.eval()
    with pytest.raises(ConfigError, match="can't be trained"):
        fast.train()


def test_the_output_is_that_of_the_network():
    plain = settled("coex")
    fast = prepare_for_inference(plain)
    left, right = torch.rand(2, 2, 3, 50, 64)
    with torch.inference_mode():
        ours, theirs = fast(left, right, return_logits=True), plain(left, right, return_logits=True)
    assert isinstance(ours, StereoOutput)
    assert_close(ours.confidence, theirs.confidence, rtol=1e-4, atol=1e-4)
    assert_close(ours.logits, theirs.logits, rtol=1e-3, atol=1e-3)


def test_it_is_saved_and_copied():
    fast = prepare_for_inference(settled("coex"))
    assert off(copy.deepcopy(fast), fast, 32, 32).max() == 0
    twin = prepare_for_inference(build_model("coex", max_disparity=32))
    twin.load_state_dict(fast.state_dict())
    assert off(twin, fast, 32, 32).max() == 0


def test_a_gradient_reaches_the_images():
    plain = settled("coex")
    fast = prepare_for_inference(plain)
    left, right = torch.rand(2, 1, 3, 32, 64)
    gradients = []
    for network in (plain, fast):
        image = left.clone().requires_grad_()
        network(image, right).disparity.mean().backward()
        gradients.append(image.grad)
    assert gradients[0].abs().max() > 0
    # in norm: rounding decides on which side of an activation's kink a value lies
    assert (gradients[1] - gradients[0]).norm() < 1e-2 * gradients[0].norm()


class Foreign(nn.Module):
    """A network of nobody's slots: batch norm before convolution, one output used twice, functions in between."""

    def __init__(self):
        super().__init__()
        self.norm_first = nn.BatchNorm2d(3)
        self.conv = nn.Conv2d(3, 8, 3, padding=1)
        self.norm = nn.BatchNorm2d(8)
        self.split = nn.Conv2d(8, 8, 3, padding=1)
        self.split_norm = nn.BatchNorm2d(8)
        self.again = nn.Conv2d(8, 8, 3, padding=1, padding_mode="reflect")
        self.weighed = nn.utils.parametrizations.weight_norm(nn.Conv2d(8, 8, 1))
        self.weighed_norm = nn.BatchNorm2d(8)
        self.out = nn.ConvTranspose2d(8, 1, 3, stride=2, padding=1)

    def features(self, image):
        x = self.norm(self.conv(self.norm_first(image))).sin()
        y = self.split(x)
        x = self.split_norm(y) + y
        return self.weighed_norm(self.weighed(self.again(x)))

    def forward(self, left, right):
        x = self.features(left) * self.features(right)
        size = (2 * left.shape[-2], 2 * left.shape[-1])
        return StereoOutput(disparity=self.out(x, output_size=size).squeeze(1))


def test_unknown_blocks_are_left_alone():
    plain = settle(Foreign())
    fast = prepare_for_inference(plain)
    assert off(fast, plain, 32, 48).max() < 1e-4
    network = fast.network
    assert isinstance(network.conv, FusedConvolution)
    assert isinstance(network.norm, nn.Identity)
    # its output is read twice
    assert isinstance(network.split, FusedConvolution)
    for left_alone in ("norm_first", "split_norm", "again", "weighed", "weighed_norm", "out"):
        assert type(getattr(network, left_alone)) is type(getattr(plain, left_alone))


class OnlyOneSize(nn.Module):
    def __init__(self):
        super().__init__()
        self.conv = nn.Conv2d(3, 1, 3, padding=1)
        self.norm = nn.BatchNorm2d(1)

    def forward(self, left, right):
        if left.shape[-1] != 40:
            raise RuntimeError("40 pixels wide, please")
        return StereoOutput(disparity=self.norm(self.conv(left - right)).squeeze(1))


def test_a_network_that_fails_on_the_example_is_used_as_it_is():
    plain = OnlyOneSize()
    with pytest.warns(UserWarning, match="40 pixels wide, please"):
        fast = prepare_for_inference(plain)
    assert isinstance(fast.network.norm, nn.BatchNorm2d)
    assert off(fast, plain.eval(), 40, 40).max() == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fast = prepare_for_inference(plain, example=(torch.rand(1, 3, 32, 40), torch.rand(1, 3, 32, 40)))
    assert isinstance(fast.network.conv, FusedConvolution)
    assert off(fast, plain.eval(), 40, 40).max() < 1e-5


class NeedsData(OnlyOneSize):
    def forward(self, left, right):
        return StereoOutput(disparity=self.norm(self.conv(left * float(right.sum() >= 0))).squeeze(1))


def test_a_network_that_looks_at_the_images_is_watched_for_real():
    plain = NeedsData()
    fast = prepare_for_inference(plain)
    assert isinstance(fast.network.conv, FusedConvolution)
    assert off(fast, plain.eval(), 40, 40).max() < 1e-5


@pytest.mark.parametrize("precision", ["double", "fp16", None])
def test_another_precision_is_refused(precision):
    with pytest.raises(ConfigError, match=r"use float32, bfloat16, float16"):
        prepare_for_inference(nn.Identity(), precision=precision)


def test_what_can_not_be_copied_is_one_line():
    class Derived(nn.Module):
        def __init__(self):
            super().__init__()
            self.weight = nn.Parameter(torch.ones(1)) * 2

    with pytest.raises(ConfigError, match=r"a Derived can't be copied .*parametrizations does it"):
        prepare_for_inference(Derived())


def test_nothing_is_prepared_twice():
    fast = prepare_for_inference(build_model("coex", max_disparity=32))
    assert isinstance(fast, PreparedNetwork)
    with pytest.raises(ConfigError, match="prepared already"):
        prepare_for_inference(fast)


@pytest.mark.filterwarnings("ignore:this CPU has no instructions")
def test_half_precision_is_near():
    plain = settled("coex")
    fast = prepare_for_inference(plain, precision="bfloat16")
    left, right = torch.rand(2, 1, 3, 64, 96)
    with torch.inference_mode():
        ours, theirs = fast(left, right, return_logits=True), plain(left, right, return_logits=True)
    assert ours.disparity.dtype == ours.confidence.dtype == torch.float32
    # random networks magnify roundings; the yardstick is what autocast alone does to the plain one
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        autocast = plain(left, right, return_logits=True)
    ours_off, autocast_off = ((output.logits.float() - theirs.logits).norm() for output in (ours, autocast))
    assert 0 < ours_off < 1.5 * autocast_off
    weights = [m.weight.dtype for m in fast.modules() if isinstance(m, FusedConvolution)]
    assert set(weights) == {torch.bfloat16}


def test_half_precision_without_instructions_is_warned_of(monkeypatch):
    monkeypatch.setattr("stereokit.optimize.inference.cpu_has", lambda dtype: False)
    with pytest.warns(UserWarning, match="no instructions for float16: float32 is faster"):
        prepare_for_inference(build_model("coex", max_disparity=32), precision="float16")


@pytest.mark.parametrize(
    "name", ["coex", *(pytest.param(name, marks=pytest.mark.slow) for name in ("psmnet", "gcnet"))]
)
def test_it_is_exported(name):
    fast = prepare_for_inference(settled(name))
    images = torch.rand(2, 1, 3, 64, 64).unbind()
    with torch.no_grad():
        program = torch.export.export(fast, images, strict=False)
        assert_close(program.module()(*images).disparity, fast(*images).disparity, rtol=1e-3, atol=1e-3)
    # a program that runs elsewhere too
    assert not any("mkldnn" in str(node.target) for node in program.graph.nodes)


@pytest.mark.slow
@every_model
def test_it_is_compiled(name):
    fast = prepare_for_inference(settled(name))
    compiled = torch.compile(fast, fullgraph=True)
    left, right = torch.rand(2, 1, 3, 64, 64)
    with torch.inference_mode():
        difference = (compiled(left, right).disparity - fast(left, right).disparity).abs()
    assert difference.quantile(0.999) < 1e-3
