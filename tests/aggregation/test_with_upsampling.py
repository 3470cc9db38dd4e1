import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import AGGREGATIONS, ConfigError, WithConfidence, WithOffsets, WithUpsampling, build_model
from stereokit.aggregation import ConfidenceNetwork, learned_upsample
from tests.strategies import randn, seeds

STACKED = {"name": "stacked_hourglass", "channels": 2}
OFFERED = {"in_channels": 3, "planes": 8}


@given(st.sampled_from([2, 4, 6]), st.tuples(*4 * [st.integers(1, 4)]), seeds)
def test_it_is_the_transposed_convolution(scale, shape, seed):
    logits = randn(seed, *shape, dtype=torch.float64)
    weight = randn(seed + 1, 1, 1, *3 * (2 * scale,), dtype=torch.float64)
    expected = F.conv_transpose3d(logits.unsqueeze(1), weight, stride=scale, padding=scale // 2).squeeze(1)
    assert_close(learned_upsample(logits, weight), expected)


def test_gradients_are_right():
    logits = torch.randn(1, 2, 2, 3, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(1, 1, 4, 4, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(learned_upsample, (logits, weight))


def test_each_head_has_its_own():
    aggregation = WithUpsampling(base=STACKED, **OFFERED)
    seen = []
    aggregation.base.register_forward_hook(lambda _module, _in, out: seen.append(out))
    heads = aggregation(torch.randn(1, 3, 8, 8, 8), {})
    for head, coarse, enlarge in zip(heads, seen[0], aggregation.enlarge, strict=True):
        assert_close(head.logits, learned_upsample(coarse, enlarge.weight))
    assert aggregation.upscale == aggregation.planes_upscale == 4
    (last,) = aggregation.eval()(torch.randn(1, 3, 8, 8, 8), {})
    assert_close(last.logits, learned_upsample(seen[1][-1], aggregation.enlarge[-1].weight))


def test_confidence_is_of_the_logits_of_its_head():
    aggregation = WithConfidence(base={"name": "with_upsampling", "base": STACKED, "scale": 2}, **OFFERED, channels=4)
    heads = aggregation(torch.randn(2, 3, 8, 8, 8), {})
    for head, network in zip(heads, aggregation.confidence, strict=True):
        assert head.logits.shape[1] == network.hidden[0].in_channels == 16
        assert_close(head.certainty, network(head.logits))


def test_the_confidence_network_equals_the_loop():
    network = ConfidenceNetwork(5, channels=3).double().eval()
    logits = torch.randn(1, 5, 3, 4, dtype=torch.float64)
    conv, norm, _ = network.hidden
    padded = F.pad(logits, (1, 1, 1, 1))
    expected = torch.zeros(1, 3, 4, dtype=torch.float64)
    for y in range(3):
        for x in range(4):
            for c in range(3):
                value = (conv.weight[c] * padded[0, :, y : y + 3, x : x + 3]).sum() / (1 + norm.eps) ** 0.5
                expected[0, y, x] += network.last.weight[0, c, 0, 0] * value.clamp(min=0)
    assert_close(network(logits), expected)


def test_wrappers_go_around_each_other():
    offsets = {"name": "with_offsets", "base": STACKED}
    aggregation = WithConfidence(base={"name": "with_upsampling", "base": offsets, "scale": 2}, **OFFERED)
    for head in aggregation(torch.randn(2, 3, 8, 8, 8), {}):
        assert head.logits.shape == head.offsets.shape == (2, 16, 16, 16)
        assert head.certainty.shape == (2, 16, 16)
    with pytest.raises(ConfigError, match=r"'with_upsampling' has\s+none"):
        WithOffsets(base={"name": "with_upsampling", "base": STACKED}, **OFFERED)


def test_the_confidence_is_that_of_the_network():
    model = build_model("psmnet", aggregation={"name": "with_confidence", "base": STACKED}, max_disparity=64).eval()
    seen = []
    model.aggregation.register_forward_hook(lambda _module, _in, out: seen.append(out[-1].certainty))
    with torch.inference_mode():
        output = model(*torch.rand(2, 1, 3, 64, 96))
    expected = F.interpolate(seen[0].unsqueeze(1), scale_factor=4, mode="bilinear").squeeze(1).sigmoid()
    assert_close(output.confidence, expected)


@pytest.mark.parametrize("scale", [3, 0, True, 2.0])
def test_odd_scales_are_refused(scale):
    with pytest.raises(ConfigError, match="even number"):
        WithUpsampling(base=STACKED, **OFFERED, scale=scale)


def test_the_third_hourglass_adds_what_it_is_told():
    torch.manual_seed(0)
    first, second = (
        AGGREGATIONS.build("stacked_hourglass", {"channels": 2, "third_takes": n}, {"in_channels": 3}) for n in (1, 2)
    )
    second.load_state_dict(first.state_dict())
    volume = torch.randn(1, 3, 8, 8, 8)
    for number, aggregation in enumerate((first, second), start=1):
        inner, taken = {}, []
        for which, hourglass in ((1, aggregation.hourglass1), (2, aggregation.hourglass2)):
            hourglass.register_forward_hook(lambda _m, _in, out, n=which, to=inner: to.update({n: out[1]}))
        aggregation.hourglass3.register_forward_pre_hook(lambda _m, given, to=taken: to.append(given[2]))
        aggregation.eval()(volume, {})
        assert taken[0] is inner[number]
    with pytest.raises(ConfigError, match="third_takes=3"):
        AGGREGATIONS.build("stacked_hourglass", {"third_takes": 3}, {"in_channels": 3})
