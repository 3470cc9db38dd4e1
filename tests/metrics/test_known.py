import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stereokit import InputError
from stereokit.metrics import StereoMetrics, bad_pixels, count_pixels, d1, end_point_error, valid_pixels

VALUES = st.lists(st.sampled_from([-300.0, -16.0, -0.5, 0.0, 0.5, 16.0, 300.0, math.nan, math.inf, -math.inf]))


@given(VALUES, st.sampled_from([-16.0, -1.0, 0.0, 2.0]), st.sampled_from([None, 3.0, 16.0]))
def test_every_pixel_falls_under_one_rule(values: list[float], floor: float, ceiling: float | None) -> None:
    truth = torch.tensor(values)
    counts = count_pixels(truth, max_disparity=ceiling, min_disparity=floor)

    def counted(value: float) -> bool:
        above = value >= floor if floor else value > 0
        return math.isfinite(value) and above and (ceiling is None or value < ceiling)

    left_out = [value for value in values if not counted(value)]
    assert counts.total == len(values)
    assert (
        counts.valid
        == sum(map(counted, values))
        == int(valid_pixels(truth, max_disparity=ceiling, min_disparity=floor).sum())
    )
    assert counts.not_finite == sum(not math.isfinite(value) for value in values)
    assert counts.negative == sum(math.isfinite(value) and value < 0 for value in left_out)
    assert counts.zero == sum(value == 0 for value in left_out)
    assert counts.too_large == sum(math.isfinite(value) and value >= (ceiling or math.inf) for value in left_out)
    assert sum(counts.dropped().values()) == counts.known - counts.valid


def test_negative_truth_counts_where_it_is_asked_for() -> None:
    truth = torch.tensor([[[-10.0, -4.0, 0.0, 100.0, -999.0, math.nan]]])
    prediction = torch.tensor([[[-12.0, -4.0, 4.0, 104.0, 0.0, 0.0]]])
    assert end_point_error(prediction, truth, min_disparity=-64) == 2.5
    assert bad_pixels(prediction, truth, 3, min_disparity=-64) == 50
    # an error of 4 px is below 5 % of 100, and above that of 0
    assert d1(prediction, truth, min_disparity=-64) == 25
    metrics = StereoMetrics(min_disparity=-64)
    metrics.update(prediction, truth)
    assert (metrics.compute()["pixels"], metrics.compute()["epe"], metrics.compute()["d1"]) == (4, 2.5, 25)
    assert StereoMetrics.from_state_dict(metrics.state_dict()).compute() == metrics.compute()
    with pytest.raises(InputError, match=r"min_disparity=-64\.0 and min_disparity=0"):
        metrics.merge(StereoMetrics())
    assert end_point_error(prediction, truth) == 4


def test_a_relative_error_is_one_of_the_size() -> None:
    truth = torch.tensor([-100.0])
    assert d1(truth + 4, truth, min_disparity=-200) == 0
    assert d1(truth + 6, truth, min_disparity=-200) == 100


@pytest.mark.parametrize(("floor", "ceiling"), [(math.nan, None), (math.inf, None), (5, 5), (-3, -4)])
def test_floors_that_leave_nothing(floor: float, ceiling: float | None) -> None:
    with pytest.raises(InputError, match="disparity is"):
        valid_pixels(torch.ones(1), max_disparity=ceiling, min_disparity=floor)
