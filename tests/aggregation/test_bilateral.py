import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.testing import assert_close

from stereokit import GCE, BilateralAggregation, ConfigError, InvertedResidualHourglass
from stereokit.aggregation import ScaleAwareAttention
from stereokit.aggregation.bilateral import join, split
from tests.aggregation.guided import (
    GUIDANCES,
    assert_gradients_are_right,
    assert_guides_matter,
    channels_at,
    guides_of,
)
from tests.strategies import randn, seeds

GUIDES = channels_at(4, 8, 16)
PLAIN = {"name": "plain", "channels": 3, "layers": 2}


def bilateral(**arguments):
    return BilateralAggregation(
        **{"in_channels": 2, "planes": 4, "guide_channels": GUIDES, "branch": PLAIN, "attention_channels": 3}
        | arguments
    )


@given(st.integers(1, 2), st.integers(1, 3), st.integers(1, 4), st.integers(1, 3), seeds)
def test_split_and_join_equal_the_loop(batch, channels, planes, side, seed):
    volume = randn(seed, batch, channels, planes, side, 2, dtype=torch.float64)
    attention = randn(seed, batch, 1, side, 2, dtype=torch.float64).sigmoid()
    first, second = split(volume, attention)
    joined = join(volume[:, 0], -3 * volume[:, -1], attention)
    for b in range(batch):
        for y in range(side):
            for x in range(2):
                a = attention[b, 0, y, x].item()
                assert_close(first[b, :, :, y, x], a * volume[b, :, :, y, x])
                assert_close(second[b, :, :, y, x], (1 - a) * volume[b, :, :, y, x])
                expected = a * volume[b, 0, :, y, x] + (1 - a) * -3 * volume[b, -1, :, y, x]
                assert_close(joined[b, :, y, x], expected)


@given(seeds)
def test_what_is_split_adds_up_and_what_is_alike_stays_when_joined(seed):
    volume = randn(seed, 1, 2, 3, 4, 5, dtype=torch.float64)
    attention = randn(seed, 1, 1, 4, 5, dtype=torch.float64).sigmoid()
    assert_close(sum(split(volume, attention)), volume)
    assert_close(join(volume[:, 0], volume[:, 0], attention), volume[:, 0])
    finer = randn(seed, 1, 3, 8, 10, dtype=torch.float64)
    assert_close(join(finer, finer, attention), finer)


@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_branches_have_guidance_of_their_own(guidance, guidance_at):
    aggregation = bilateral(guidance=guidance, guidance_at=guidance_at)
    assert aggregation.guide_channels == GUIDES
    places = 0 if guidance is None else 2 if guidance_at == "one" else 4
    assert sum(isinstance(m, guidance or ()) for m in aggregation.modules()) == places
    volume, guides = torch.randn(2, 2, 4, 8, 12), guides_of(aggregation, (8, 12), stride=4, batch=2)
    (logits,) = aggregation(volume, guides)
    assert logits.shape == (2, 4, 8, 12)
    assert_guides_matter(aggregation, volume, guides)


@pytest.mark.parametrize("full", [True, False])
def test_where_the_attention_is_whole_one_branch_speaks_alone(full):
    aggregation = bilateral().eval()
    volume, guides = torch.randn(1, 2, 4, 8, 12), guides_of(bilateral(), (8, 12), stride=4)
    nn.init.zeros_(aggregation.attention.head[1].weight)
    aggregation.attention.head[2] = nn.Threshold(1, 1.0 if full else 0.0)
    expected = aggregation.branches[0 if full else 1](volume, guides)
    assert_close(aggregation(volume, guides)[-1], expected[-1])


@pytest.mark.parametrize(("dims", "width", "levels"), [(3, 3, 4), (2, 1, 3)])
def test_the_volume_may_be_embedded_first(dims, width, levels):
    aggregation = bilateral(channels=3, dims=dims).eval()
    seen = []
    aggregation.branches[0].register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    volume, guides = torch.randn(1, 2, 4, 8, 12), guides_of(aggregation, (8, 12), stride=4)
    assert aggregation(volume, guides)[-1].shape == (1, 4, 8, 12)
    assert seen[0].shape == (1, width, levels, 8, 12)


def test_it_is_as_its_branch_is():
    coarse = bilateral(branch={"name": "inverted_residual", "blocks": [1, 1, 1]}, in_channels=1)
    assert isinstance(coarse.branches[1], InvertedResidualHourglass)
    assert (coarse.multiple, coarse.planes_multiple, coarse.upscale) == (4, 1, 1)
    stacked = bilateral(branch={"name": "gwc_hourglass", "channels": 4}, in_channels=4, planes=8)
    assert stacked.loss_weights == stacked.branches[0].loss_weights
    assert len(stacked.loss_weights) > 1
    volume, guides = torch.randn(1, 4, 8, 8, 8), guides_of(stacked, (8, 8), stride=4)
    assert len(stacked(volume, guides)) == len(stacked.loss_weights)


def test_attention_is_the_sigmoid_of_three_scales():
    attention = ScaleAwareAttention(guide_channels=GUIDES, channels=2).eval()
    guides = guides_of(attention, (8, 12), stride=4)
    found = attention(guides)
    assert found.shape == (1, 1, 8, 12)
    assert ((found > 0) & (found < 1)).all()
    for stride in GUIDES:
        changed = attention(guides | {stride: guides[stride] + torch.randn_like(guides[stride])})
        assert not torch.equal(changed, found)


def test_gradients_are_right():
    aggregation = bilateral(guidance=GCE, channels=2).eval().double()
    assert_gradients_are_right(aggregation, torch.randn(1, 2, 4, 4, 4), guides_of(aggregation, (4, 4), stride=4))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"guide_channels": {4: 3}}, "stride 8, 16 too"),
        ({"dims": 2}, "channels=None"),
        ({"dims": 1, "channels": 3}, "dims=1"),
        ({"branch": "planes"}, "unknown aggregation"),
        ({"branch": {"name": "plain", "stride": 4}}, "stride of the branch"),
        ({"branch": "hourglass", "channels": 12, "dims": 2}, "multiples of 8"),
    ],
)
def test_what_can_not_be_is_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        bilateral(**arguments)
