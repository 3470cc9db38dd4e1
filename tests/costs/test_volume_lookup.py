import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError
from stereokit.costs import VolumeLookup, look_up_volume, volume_pyramid
from tests.strategies import seeds


@st.composite
def drawn(draw):
    generator = torch.Generator().manual_seed(draw(seeds))
    levels = draw(st.integers(1, 3))
    planes = draw(st.integers(2 ** (levels - 1), 9))
    volume = torch.randn(draw(st.integers(1, 2)), draw(st.integers(1, 3)), planes, 2, 3, generator=generator)
    disparity = (planes + 6) * torch.rand(volume.shape[0], 2, 3, generator=generator) - 3
    return volume.double(), disparity.double(), levels, draw(st.integers(0, 2))


def loop(volume, disparity, levels, radius):
    """The equation, number by number."""
    batch, channels, _, height, width = volume.shape
    found = torch.zeros(batch, levels, channels, 2 * radius + 1, height, width, dtype=volume.dtype)
    for b in range(batch):
        for c in range(channels):
            for y in range(height):
                for x in range(width):
                    planes = volume[b, c, :, y, x].tolist()
                    for level in range(levels):
                        if level:
                            planes = [(planes[2 * i] + planes[2 * i + 1]) / 2 for i in range(len(planes) // 2)]
                        for k in range(-radius, radius + 1):
                            place = disparity[b, y, x].item() / 2**level + k
                            low, share = math.floor(place), place - math.floor(place)
                            near = [planes[p] if 0 <= p < len(planes) else 0.0 for p in (low, low + 1)]
                            found[b, level, c, k + radius, y, x] = near[0] * (1 - share) + near[1] * share
    return found.flatten(1, 3)


@given(drawn())
def test_it_equals_the_loop(case):
    volume, disparity, levels, radius = case
    assert_close(look_up_volume(volume_pyramid(volume, levels), disparity, radius), loop(*case))


@given(drawn())
def test_gradients_reach_volume_and_disparity(case):
    volume, disparity, levels, radius = case
    # away from whole disparities, where the interpolation has a corner
    disparity = disparity.floor() + 0.3

    def run(volume, disparity):
        return look_up_volume(volume_pyramid(volume, levels), disparity, radius)

    inputs = (volume.requires_grad_(), disparity.requires_grad_())
    assert torch.autograd.gradcheck(run, inputs, fast_mode=True)


def test_a_peak_is_found_where_it_is():
    volume = torch.zeros(1, 1, 12, 1, 1)
    volume[:, :, 7] = 1
    lookup = VolumeLookup(channels=1, levels=1, radius=3)
    assert lookup(volume_pyramid(volume, 1), torch.full((1, 1, 1), 5.0)).flatten().tolist() == [0, 0, 0, 0, 0, 1, 0]
    assert lookup.out_channels == 7


@pytest.mark.parametrize("arguments", [{"levels": 0}, {"radius": -1}])
def test_lookups_that_can_not_be_are_refused(arguments):
    with pytest.raises(ConfigError, match="lookup"):
        VolumeLookup(channels=8, **arguments)


def test_too_few_planes_are_refused():
    with pytest.raises(InputError, match="at least 4 planes; got 3"):
        volume_pyramid(torch.rand(1, 1, 3, 2, 2), 3)
