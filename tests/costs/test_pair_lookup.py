import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, InputError
from stereokit.costs import PairLookup, correlation_pyramid, look_up, look_up_on_demand, pair_lookup
from tests.strategies import seeds


@st.composite
def drawn(draw):
    generator = torch.Generator().manual_seed(draw(seeds))
    levels = draw(st.integers(1, 3))
    width = draw(st.integers(2 ** (levels - 1), 9))
    shape = (draw(st.integers(1, 2)), draw(st.integers(1, 4)), 2, width)
    left, right = torch.randn(2, *shape, generator=generator, dtype=torch.float64)
    disparity = (width + 4) * torch.rand((shape[0], 2, width), generator=generator, dtype=torch.float64) - 2
    return left, right, disparity, levels, draw(st.integers(0, 2))


def loop(left, right, disparity, levels, radius):
    """The equations, number by number."""
    batch, channels, height, width = left.shape
    found = torch.zeros(batch, levels * (2 * radius + 1), height, width, dtype=left.dtype)
    for b in range(batch):
        for y in range(height):
            for x in range(width):
                row = (left[b, :, y, x, None] * right[b, :, y]).sum(0) / math.sqrt(channels)
                for level in range(levels):
                    if level:
                        row = torch.stack([(row[2 * i] + row[2 * i + 1]) / 2 for i in range(len(row) // 2)])
                    for k in range(-radius, radius + 1):
                        place = (x - disparity[b, y, x].item()) / 2**level + k
                        low, share = math.floor(place), place - math.floor(place)
                        near = [row[c].item() if 0 <= c < len(row) else 0.0 for c in (low, low + 1)]
                        value = near[0] * (1 - share) + near[1] * share
                        found[b, level * (2 * radius + 1) + k + radius, y, x] = value
    return found


@given(drawn())
def test_both_forms_equal_the_loop(case):
    left, right, disparity, levels, radius = case
    expected = loop(left, right, disparity, levels, radius)
    assert_close(look_up(correlation_pyramid(left, right, levels), disparity, radius), expected)
    assert_close(look_up_on_demand(left, right, disparity, radius, levels), expected)


@given(drawn())
def test_both_forms_have_the_same_gradients(case):
    left, right, disparity, levels, radius = case
    gradients = []
    for form in ("volume", "on_demand"):
        inputs = [x.clone().requires_grad_() for x in (left, right, disparity)]
        lookup = PairLookup(levels=levels, radius=radius, form=form)
        lookup(lookup.of(*inputs[:2]), inputs[2]).square().sum().backward()
        gradients.append([x.grad for x in inputs])
    for one, other in zip(*gradients, strict=True):
        assert_close(one, other)


def test_rows_that_are_computed_apart_change_nothing(monkeypatch):
    left, right = torch.rand(2, 2, 4, 7, 12)
    disparity = 10 * torch.rand(2, 7, 12)
    whole = look_up_on_demand(left, right, disparity, 4, 2)
    monkeypatch.setattr(pair_lookup, "GATHERED", 2 * 2 * 4 * 12 * 10)
    assert_close(look_up_on_demand(left, right, disparity, 4, 2), whole)


def test_what_memory_can_not_hold_is_computed_on_demand(monkeypatch):
    maps = torch.rand(2, 1, 4, 8, 16)
    needed = 2 * 4 * 8 * 16**2
    for free, held in ((2 * needed + 1, True), (2 * needed, False), (None, True)):
        monkeypatch.setattr(pair_lookup, "available_memory", lambda _device, free=free: free)
        assert (PairLookup().of(*maps).pyramid is not None) is held
    assert PairLookup(form="volume").of(*maps).pyramid is not None
    assert PairLookup(form="on_demand").of(*maps).pyramid is None


def test_a_match_is_found_where_it_is():
    torch.manual_seed(0)
    right = torch.randn(1, 64, 3, 40)
    found = look_up(correlation_pyramid(right.roll(6, -1), right, 1), torch.full((1, 3, 40), 4.0), 4)
    # looking 4 px to the left, the match lies 2 px further
    assert (found[..., 12:].argmax(1) == 4 - 2).all()


@pytest.mark.parametrize("arguments", [{"levels": 0}, {"radius": -1}, {"form": "sparse"}])
def test_lookups_that_can_not_be_are_refused(arguments):
    with pytest.raises(ConfigError, match="lookup"):
        PairLookup(**arguments)


def test_maps_too_narrow_for_the_pyramid_are_refused():
    with pytest.raises(InputError, match="at least 8 columns; got 7"):
        correlation_pyramid(*torch.rand(2, 1, 4, 2, 7), 4)
