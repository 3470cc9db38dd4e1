import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import GCE, AdaptiveAggregation, ConfigError
from stereokit.aggregation import CrossScale
from stereokit.layers import DeformableConvolution
from tests.aggregation.guided import GUIDANCES, assert_guides_matter, channels_at, guides_of
from tests.strategies import randn, seeds

GUIDES = channels_at(4, 8, 16)


def adaptive(**arguments):
    settings = {"in_channels": 1, "planes": 8, "stride": 4, "guide_channels": GUIDES, "modules": 2, "deformable": 1}
    return AdaptiveAggregation(**{**settings, **arguments})


def pyramid(seed, *, batch=1, channels=1, planes=8, height=8, width=12, dtype=torch.float32):
    return [
        randn(seed + scale, batch, channels, planes >> scale, height >> scale, width >> scale, dtype=dtype)
        for scale in range(3)
    ]


@settings(max_examples=20)
@given(st.integers(1, 2), st.integers(1, 2), seeds)
def test_scales_are_summed_one_by_one(rows, columns, seed):
    block = CrossScale((4, 2, 1)).eval().double()
    maps = [
        randn(seed + scale, 1, 4 >> scale, 4 * rows >> scale, 4 * columns >> scale, dtype=torch.float64)
        for scale in range(3)
    ]
    for target, given_ in enumerate(block(maps)):
        expected = maps[target]
        for source, x in enumerate(maps):
            layers = block.exchange[target][source]
            if source > target:
                size = maps[target].shape[-2:]
                expected = expected + F.interpolate(layers[0](x), size, mode="bilinear", align_corners=False)
            elif source < target:
                for layer in layers:
                    x = layer(x)
                assert len(layers) == target - source
                expected = expected + x
        assert_close(given_, torch.where(expected > 0, expected, 0.2 * expected))
    assert len(block(maps, outputs=1)) == 1
    assert_close(block(maps, outputs=1)[0], block(maps)[0])


@pytest.mark.parametrize("guidance", GUIDANCES)
@pytest.mark.parametrize("guidance_at", ["one", "full"])
def test_guidance_acts_where_it_is_placed(guidance, guidance_at):
    aggregation = adaptive(guidance=guidance, guidance_at=guidance_at)
    wanted = {} if guidance is None else {4: GUIDES[4]} if guidance_at == "one" else GUIDES
    assert aggregation.guide_channels == wanted
    volumes, guides = pyramid(0, batch=2), guides_of(aggregation, (8, 12), stride=4, batch=2)
    heads = aggregation(volumes, guides)
    assert [tuple(logits.shape) for logits in heads] == [(2, 2, 2, 3), (2, 4, 4, 6), (2, 8, 8, 12)]
    finest, *coarser = volumes
    assert_guides_matter(lambda volume, guides: aggregation([volume, *coarser], guides), finest, guides)


def test_full_guidance_is_three_places():
    blocks = [m for m in adaptive(guidance=GCE, guidance_at="full").modules() if isinstance(m, GCE)]
    assert [(b.guide_channels, b.volume_channels) for b in blocks] == [(GUIDES[4], 8), (GUIDES[8], 4), (GUIDES[16], 2)]


@settings(max_examples=5)
@given(seeds)
def test_eval_mode_gives_the_finest_head_alone(seed):
    aggregation = adaptive().eval().double()
    volumes = pyramid(seed, dtype=torch.float64)
    (alone,) = aggregation(volumes, {})
    # all heads, while the norms stay in eval mode
    aggregation.training = True
    assert_close(aggregation(volumes, {})[-1], alone)


def test_the_last_modules_are_deformable():
    aggregation = adaptive(modules=3, deformable=2)
    bent = [any(isinstance(m, DeformableConvolution) for m in module.modules()) for module in aggregation.stack]
    assert bent == [False, True, True]


def test_volumes_of_several_channels_are_joined():
    aggregation = adaptive(in_channels=3).eval()
    for join in aggregation.join:
        nn.init.zeros_(join.weight)
        join.weight.data[:, 1] = 1
    volumes = pyramid(0, channels=3)
    one = adaptive(in_channels=1).eval()
    one.load_state_dict({k: v for k, v in aggregation.state_dict().items() if not k.startswith("join.")})
    assert_close(aggregation(volumes, {})[-1], one([v[:, 1:2] for v in volumes], {})[-1])


@pytest.mark.parametrize("arguments", [{"planes": 12}, {"modules": 0}, {"modules": 1, "deformable": 2}])
def test_what_can_not_be_is_refused(arguments):
    with pytest.raises(ConfigError, match=r"multiple of 8|deformable modules"):
        adaptive(**arguments)
