from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from torch.testing import assert_close

from stereokit import GCE, AdditiveGuidance, ConfigError, ScalingGuidance
from stereokit.guidance.excitation import excite
from tests.strategies import randn, seeds

BLOCKS = [GCE, AdditiveGuidance, partial(ScalingGuidance, reduction=2)]


@st.composite
def volumes_and_guides(draw, guide_channels=5, volume_channels=3):
    batch, levels = draw(st.integers(1, 2)), draw(st.integers(1, 5))
    size = draw(st.integers(1, 4)), draw(st.integers(1, 4))
    volume = randn(draw(seeds), batch, volume_channels, levels, *size, dtype=torch.float64)
    guide = draw(st.sampled_from([0.1, 1, 100])) * randn(draw(seeds), batch, guide_channels, *size, dtype=torch.float64)
    return volume, guide


@given(volumes_and_guides(guide_channels=3))
def test_excite_equals_the_loop(drawn):
    volume, logits = drawn
    expected = torch.zeros_like(volume)
    for d in range(volume.shape[2]):
        expected[:, :, d] = volume[:, :, d] / (1 + (-logits).exp())
    assert_close(excite(volume, logits), expected)


@given(volumes_and_guides())
def test_gce_never_grows_a_voxel(drawn):
    volume, guide = drawn
    excited = GCE(5, 3).double().eval()(volume, guide)
    assert (excited.abs() <= volume.abs()).all()
    assert (excited * volume >= 0).all()


@given(volumes_and_guides())
def test_the_factor_of_gce_is_the_same_at_every_disparity(drawn):
    volume, guide = drawn
    block = GCE(5, 3).double().eval()
    factor = block(torch.ones_like(volume), guide)
    assert_close(factor, factor[:, :, :1].expand_as(factor), rtol=0, atol=0)
    assert_close(block(volume, guide), factor * volume)
    assert_close(factor[:, :, 0], block.network(guide).sigmoid())


@given(volumes_and_guides())
def test_the_summand_of_addition_is_the_same_at_every_disparity(drawn):
    volume, guide = drawn
    block = AdditiveGuidance(5, 3).double().eval()
    summand = block(torch.zeros_like(volume), guide)
    assert_close(summand, block.network(guide).unsqueeze(2).expand_as(volume))
    assert_close(block(volume, guide), volume + summand)


@given(volumes_and_guides())
def test_the_factor_of_scaling_is_the_same_at_every_disparity_and_any_number(drawn):
    volume, guide = drawn
    block = ScalingGuidance(5, 3, activation="relu6").double().eval()
    assert_close(block(volume, guide), volume * block.network(guide).unsqueeze(2))
    assert_close(block(-2 * volume, guide), -2 * block(volume, guide))
    # of the guide's own width inside
    assert block.network[0][0].out_channels == 5


@pytest.mark.parametrize("block", BLOCKS)
def test_an_unknown_activation_is_refused(block):
    with pytest.raises(ConfigError, match="unknown activation"):
        block(5, 3, activation="sine")
    with pytest.raises(ConfigError, match="reduction"):
        ScalingGuidance(5, 3, reduction=0)


@pytest.mark.parametrize("block", BLOCKS)
def test_gradients_reach_volume_and_guide(block):
    volume = torch.randn(2, 3, 4, 3, 3, requires_grad=True)
    guide = torch.randn(2, 5, 3, 3, requires_grad=True)
    block(guide_channels=5, volume_channels=3)(volume, guide).square().sum().backward()
    assert (volume.grad != 0).all()
    assert (guide.grad != 0).any((2, 3)).all()


@pytest.mark.parametrize("block", BLOCKS)
def test_gradients_are_right(block):
    module = block(guide_channels=3, volume_channels=2).double()
    volume = torch.randn(2, 2, 2, 2, 2, dtype=torch.float64, requires_grad=True)
    guide = torch.randn(2, 3, 2, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(module, (volume, guide))
    assert torch.autograd.gradcheck(module.eval(), (volume, guide))


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.parametrize(("guide_channels", "hidden"), [(96, 48), (1, 1), (5, 2)])
def test_the_guide_passes_two_pointwise_convolutions(block, guide_channels, hidden):
    module = block(guide_channels, 8)
    convs = [m for m in module.modules() if isinstance(m, nn.Conv2d)]
    assert [(c.in_channels, c.out_channels, c.kernel_size) for c in convs] == [
        (guide_channels, hidden, (1, 1)),
        (hidden, 8, (1, 1)),
    ]
    assert convs[0].bias is None
    assert convs[1].bias is not None
    assert (module.guide_channels, module.volume_channels) == (guide_channels, 8)


def test_an_untrained_gce_halves_where_the_guide_is_zero():
    volume = torch.randn(1, 8, 4, 2, 2)
    assert_close(GCE(6, 8).eval()(volume, torch.zeros(1, 6, 2, 2)), volume / 2)
