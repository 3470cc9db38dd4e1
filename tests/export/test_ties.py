from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from stereokit import ConfigError, build_model
from stereokit.backends import Estimate
from stereokit.export.checking import TIES, check_exact, compare, random_pair
from stereokit.export.ties import Tie, tied_pixels
from tests.export.networks import Tiny

PAIR = random_pair(40, 50)


@given(st.lists(st.integers(-5, 5), min_size=2, max_size=9), st.data())
def test_a_tie_is_between_the_last_one_kept_and_the_next(values, data):
    k = data.draw(st.integers(1, len(values)))
    logits = torch.tensor(values, dtype=torch.float32).reshape(1, -1, 1, 1)
    ordered = sorted(values, reverse=True)
    expected = k < len(values) and ordered[k - 1] == ordered[k]
    assert bool(Tie(k)(logits)) == expected
    nudged = logits + 1e-7 * torch.arange(len(values)).reshape(1, -1, 1, 1)
    assert bool(Tie(k)(nudged)) == expected or not any(values)


def flat(**overrides):
    """A network for which all candidates are alike."""
    model = build_model("coex", max_disparity=32, **overrides).eval()
    for parameter in model.aggregation.parameters():
        nn.init.zeros_(parameter)
    return model


def test_a_flat_distribution_ties_everywhere_unless_all_is_kept():
    assert tied_pixels(flat(), *PAIR).all()
    assert not tied_pixels(flat(top_k=8), *PAIR).any()
    assert tied_pixels(flat(), *PAIR).shape == (1, 40, 50)
    assert not tied_pixels(Tiny(), *PAIR).any()


def test_only_what_a_tie_explains_is_forgiven():
    def shifted(left, right):
        output = model(left, right)
        return Estimate(output.disparity.detach().numpy() + 1, output.confidence.detach().numpy())

    model = flat()
    [difference] = compare(shifted, model, [("a pair", PAIR)])
    assert difference.tied == difference.above_tolerance == 1
    assert "100 % (100 % where candidates tie)" in str(difference)
    check_exact([replace(difference, above_tolerance=TIES, tied=TIES)])
    with pytest.raises(ConfigError, match="ties aside"):
        check_exact([replace(difference, above_tolerance=TIES, tied=TIES / 2)])
    # where everything ties, nothing is proved
    with pytest.raises(ConfigError, match="ties aside"):
        check_exact([difference])
    model = flat(top_k=8)
    with pytest.raises(ConfigError, match="100 % and 1 px"):
        check_exact(compare(shifted, model, [("a pair", PAIR)]))
