import math

import torch
from hypothesis import given
from torch.testing import assert_close

from stereokit.layers import bin_shift
from tests.strategies import logits


@given(logits())
def test_it_equals_the_loop(x):
    expected = [0.5 + 0.5 * max(-1.0, min(1.0, 1.5 * math.tanh(v))) for v in x.flatten().tolist()]
    assert_close(bin_shift(x), torch.tensor(expected, dtype=x.dtype).reshape(x.shape))


@given(logits())
def test_it_stays_in_the_bin_and_grows(x):
    ordered = bin_shift(x.flatten().sort().values)
    assert ((ordered >= 0) & (ordered <= 1)).all()
    assert (ordered.diff() >= 0).all()
    assert_close(bin_shift(-x), 1 - bin_shift(x))
