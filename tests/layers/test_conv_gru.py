import torch
from hypothesis import given
from torch.testing import assert_close

from stereokit.layers import ConvGRU
from tests.strategies import seeds


def drawn(seed):
    generator = torch.Generator().manual_seed(seed)
    state, one, other = (torch.randn(2, c, 3, 5, generator=generator).tanh() for c in (4, 3, 2))
    return state, torch.randn(3, 2, 4, 3, 5, generator=generator), one, other


@given(seeds)
def test_it_is_the_equation(seed):
    state, context, one, other = drawn(seed)
    torch.manual_seed(seed)
    unit = ConvGRU(4, 5)
    hx = torch.cat((state, one, other), 1)
    z = torch.sigmoid(unit.update(hx) + context[0])
    r = torch.sigmoid(unit.reset(hx) + context[1])
    q = torch.tanh(unit.candidate(torch.cat((r * state, one, other), 1)) + context[2])
    assert_close(unit(state, context, one, other), (1 - z) * state + z * q)


@given(seeds)
def test_the_state_stays_between_what_it_was_and_one(seed):
    state, context, *inputs = drawn(seed)
    torch.manual_seed(seed)
    after = ConvGRU(4, 5)(state, 10 * context, *inputs)
    assert (after.abs() <= state.abs().clamp(min=1)).all()


def test_a_gate_that_is_shut_keeps_the_state():
    state, context, *inputs = drawn(0)
    shut = torch.stack((torch.full_like(state, -1e4), context[1], context[2]))
    assert_close(ConvGRU(4, 5)(state, shut, *inputs), state)
