import pytest
import torch
from torch import Tensor

from stereokit import StereoModel, build_model
from stereokit.bench.stages import STAGES, StageClock, stages_of


class SlotClock:
    """Every reading is a second later than the one before."""

    def __init__(self) -> None:
        self.readings = 0

    def __call__(self) -> float:
        self.readings += 1
        return float(self.readings)


@pytest.mark.parametrize("name", ["coex", "psmnet", "gcnet", "aanet"])
def test_stages_of_every_network_sum_to_the_pass(name: str) -> None:
    model = build_model(name, max_disparity=96).eval()
    images = torch.rand(2, 1, 3, 64, 64)
    clock = SlotClock()
    with torch.inference_mode():
        before = model(*images).disparity
        with StageClock(model, clock=clock) as split:
            inside = model(*images).disparity
            model(*images)
        readings = clock.readings
        after = model(*images).disparity
    assert torch.equal(before, inside)
    assert torch.equal(before, after)
    assert clock.readings == readings
    assert len(split.passes) == 2
    for stages in split.passes:
        assert set(stages) == {*(name for name, _ in stages_of(model)), "rest"}
        if isinstance(model, StereoModel):
            assert set(stages) >= set(STAGES.values())
        assert sum(stages.values()) == (readings / 2 - 1)
        assert all(stages[stage] > 0 for stage in stages)


def test_the_confidence_belongs_to_the_regression() -> None:
    model = build_model("coex", max_disparity=64).eval()
    images = torch.rand(2, 1, 3, 32, 64)

    def slow(logits: Tensor, candidates: Tensor | None) -> tuple[Tensor, Tensor]:
        clock.readings += 50
        return torch.zeros_like(logits[:, 0]), torch.zeros_like(logits[:, 0])

    clock = SlotClock()
    model.regression.with_confidence = slow  # type: ignore[method-assign]
    with torch.inference_mode(), StageClock(model, clock=clock) as split:
        model(*images)
    assert split.passes[0]["regression"] == 51


def test_the_clock_is_taken_off_after_an_error() -> None:
    model = build_model("coex", max_disparity=64).eval()
    clock = SlotClock()
    with pytest.raises(Exception, match=r"RGB"), StageClock(model, clock=clock):
        model(torch.rand(1, 1, 32, 64), torch.rand(1, 1, 32, 64))
    readings = clock.readings
    with torch.inference_mode():
        model(*torch.rand(2, 1, 3, 32, 64))
    assert clock.readings == readings
