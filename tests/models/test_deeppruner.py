"""What is DeepPruner's own."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.testing import assert_close

from stereokit import ConfigError, build_model
from stereokit.losses import named_loss
from stereokit.models.deeppruner import FlatHourglass, Refinement, mending, pruned_candidates
from stereokit.weights.key_map import PUBLISHED
from tests.golden import published_state
from tests.shared import needs_shared

NAMES = ["deeppruner_best", "deeppruner_fast"]

levels = st.integers(9, 48)


@needs_shared
@pytest.mark.parametrize("name", NAMES)
def test_every_published_weight_has_one_place(name):
    state = published_state(name)
    fitting = [published for published in PUBLISHED if not published.left_over(state)]
    assert [published.network for published in fitting] == [name]
    ours = {key: value.shape for key, value in build_model(name).state_dict().items()}
    assert {fitting[0].keys.rename(key): value.shape for key, value in state.items()} == ours


@given(levels, st.floats(0, 1), st.floats(0, 1))
def test_the_pruned_range_holds_both_ends_and_is_wide_enough(last, one, other):
    low, high = (torch.full((1, 1, 1, 1), share * last) for share in sorted((one, other)))
    candidates = pruned_candidates(low, high, last).flatten()
    assert len(candidates) == 9
    assert (candidates == candidates.round()).all()
    assert (candidates.diff() >= 0).all()
    assert candidates[0] >= 0
    assert candidates[-1] <= last
    assert candidates[0] <= low
    assert candidates[-1] >= high - 1e-4
    # at the end of all that may be, there is no room
    assert candidates[-1] - candidates[0] >= min(7, last - candidates[0].item()) - 1e-4


def test_ends_that_have_crossed_are_taken_apart():
    candidates = pruned_candidates(torch.full((1, 1, 1, 1), 20.0), torch.full((1, 1, 1, 1), 10.0), 48).flatten()
    assert (candidates.diff() >= 0).all()
    assert candidates[-1] - candidates[0] >= 7


def test_the_hourglass_keeps_candidates_apart_where_it_halves():
    hourglass = FlatHourglass().eval()
    with torch.inference_mode():
        assert hourglass(torch.rand(1, 16, 5, 8, 16)).shape == (1, 5, 8, 16)


def test_refinement_without_its_last_layer_leaves_the_disparity():
    refine = Refinement(3).eval()
    torch.nn.init.zeros_(refine.residual.weight)
    disparity = torch.randn(1, 1, 6, 8)
    assert_close(refine(disparity, torch.rand(1, 3, 6, 8)), disparity.relu())


def test_mending_changes_nothing_at_first():
    x = torch.rand(1, 2, 7, 9)
    assert_close(mending(2)(x), x)


@pytest.mark.parametrize(("name", "strides"), [(NAMES[0], [4, 4, 2, 1]), (NAMES[1], [8, 8, 4, 2, 1])])
def test_ends_stand_for_quantiles(name, strides):
    output = build_model(name, max_disparity=96)(*torch.rand(2, 2, 3, 64, 64))
    assert [p.stride for p in output.predictions] == strides
    assert [p.quantile for p in output.predictions[:3]] == [0.05, 0.95, None]
    # an end that lies too low costs more where it stands for what is above
    truth, loss = torch.full((2, 64, 64), 1e3), named_loss("quantile")
    low, high = (p._replace(disparity=torch.zeros_like(p.disparity)) for p in output.predictions[:2])
    assert loss(high, truth, max_disparity=None) > loss(low, truth, max_disparity=None)


def test_a_pair_has_one_result():
    model = build_model("deeppruner_best", max_disparity=48).eval()
    images = torch.rand(2, 1, 3, 40, 60)
    with torch.inference_mode():
        assert torch.equal(model(*images).disparity, model(*images).disparity)


@pytest.mark.parametrize(("name", "max_disparity"), [(NAMES[0], 44), (NAMES[0], 50), (NAMES[1], 88), (NAMES[1], 100)])
def test_disparities_that_it_can_not_look_for_are_refused(name, max_disparity):
    with pytest.raises(ConfigError, match=r"max_disparity|particles"):
        build_model(name, max_disparity=max_disparity)
