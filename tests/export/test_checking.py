import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stereokit import ConfigError, InputError
from stereokit.backends import Estimate
from stereokit.export.checking import OUTLIERS, check_exact, check_pairs, check_size, compare, random_pair
from tests.export.networks import Tiny


class Shifted:
    """The network itself, off by a little at some pixels."""

    def __init__(self, model, by, share):
        self.model, self.by, self.share = model, by, share

    @torch.inference_mode()
    def __call__(self, left, right):
        output = self.model(left, right)
        disparity = output.disparity.numpy().copy()
        disparity.reshape(-1)[: round(self.share * disparity.size)] += self.by
        return Estimate(disparity, output.confidence.numpy())


PAIR = [("a pair", random_pair(40, 50))]


@given(by=st.floats(-5, 5, width=32), share=st.floats(0, 1))
def test_a_difference_is_what_was_added(by, share):
    model = Tiny().eval()
    [difference] = compare(Shifted(model, by, share), model, PAIR)
    share = round(share * 2000) / 2000
    assert difference.mean == pytest.approx(abs(by) * share, abs=1e-5)
    assert difference.size == (40, 50)
    if abs(by) > 1.001:
        assert difference.above_1px == difference.above_tolerance == pytest.approx(share)
    if abs(by) < 0.009:
        assert difference.above_tolerance == 0


def test_ties_are_forgiven_and_more_is_not():
    model = Tiny().eval()
    check_exact(compare(Shifted(model, 9, OUTLIERS / 2), model, PAIR))
    with pytest.raises(ConfigError, match=r"wrong and was not kept: a pair, 50 x 40 px"):
        check_exact(compare(Shifted(model, 0.02, 2 * OUTLIERS), model, PAIR))
    with pytest.raises(ConfigError, match=r"not finite"):
        compare(Shifted(model, np.nan, 0.01), model, PAIR)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_a_confidence_that_is_not_finite_is_wrong(wrong):
    def broken(left, right):
        output = model(left, right)
        return Estimate(output.disparity.numpy(), np.full_like(output.confidence.numpy(), wrong))

    model = Tiny().eval()
    with torch.inference_mode(), pytest.raises(ConfigError, match="values that are not finite"):
        compare(broken, model, PAIR)


def test_pairs_of_another_size_are_refused_before_the_export():
    pairs = [random_pair(40, 64)]
    check_size(pairs, None, "to compare on")
    check_size(pairs, (40, 64), "to compare on")
    with pytest.raises(InputError, match="a pair to compare on is 64 x 40 pixels, but the export is for 60 x 40"):
        check_size(pairs, (40, 60), "to compare on")


def test_the_pairs_are_textured_and_seen_from_two_places():
    left, right = random_pair(50, 60)
    assert left.shape == right.shape == (1, 3, 50, 60)
    assert 0 <= left.min() < left.max() <= 1
    assert left.std() > 0.05
    assert not torch.equal(left, right)


def test_a_fixed_size_is_checked_on_that_size_alone():
    [(_, (left, _))] = check_pairs(Tiny(), (40, 64))
    assert left.shape[-2:] == (40, 64)
    fitting, odd = (pair[0].shape[-2:] for _, pair in check_pairs(Tiny(), None))
    assert not any(side % 8 for side in fitting)
    assert all(side % 8 for side in odd)


def test_a_confidence_that_is_another_is_wrong():
    def unsure(by):
        def backend(left, right):
            output = model(left, right)
            return Estimate(output.disparity.numpy(), output.confidence.numpy() + by)

        return backend

    model = Tiny().eval()
    with torch.inference_mode():
        check_exact(compare(unsure(0.001), model, PAIR))
        differences = compare(unsure(0.1), model, PAIR)
        assert differences[0].confidence == pytest.approx(0.1, abs=1e-5)
        with pytest.raises(ConfigError, match="wrong and was not kept"):
            check_exact(differences)


@pytest.mark.parametrize("everywhere", [True, False])
def test_of_the_pixels_with_ties_those_that_are_far_count(monkeypatch, everywhere):
    def ties(model, left, right):
        return torch.full((1, *left.shape[-2:]), everywhere)

    monkeypatch.setattr("stereokit.export.checking.tied_pixels", ties)
    model = Tiny().eval()
    [difference] = compare(Shifted(model, 0.5, 0.25), model, PAIR)
    assert difference.above_tolerance == 0.25
    assert difference.tied == (0.25 if everywhere else 0)
