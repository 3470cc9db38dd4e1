from dataclasses import replace

import pytest
import torch

from stereokit.errors import CheckpointError, ConfigError, StereoKitError
from stereokit.training import Schedule, with_length
from stereokit.training.resume import RunFolder
from tests.training.tiny import TINY


def of(schedule):
    return {"recipe": replace(TINY, schedule=schedule).to_dict(), "seed": 0}


@pytest.mark.parametrize(
    "course", [{"kind": "exponential", "factor": 0.5, "every": 1.0}, {"milestones": (1.0,), "factor": 0.5}]
)
def test_the_length_may_change_and_the_course_may_not(tmp_path, course):
    folder = RunFolder(tmp_path / "run")
    schedule = Schedule(batch=2, epochs=3, **course)
    folder.prepare(of(schedule), {}, resume=False)
    before = folder.record.read_text()
    in_steps = with_length(replace(TINY, schedule=schedule), steps=50).schedule
    for longer in (replace(schedule, epochs=6), in_steps, replace(in_steps, steps=100)):
        folder.prepare(of(longer), {}, resume=True)
    key = "every" if "every" in course else "milestones"
    others = {"every": 2.0} if key == "every" else {"milestones": (2.0,)}
    with pytest.raises(ConfigError, match=rf"was started with schedule\.{key} "):
        folder.prepare(of(replace(schedule, **others)), {}, resume=True)
    with pytest.raises(ConfigError, match=r"was started with schedule\.factor 0\.5, not 0\.25"):
        folder.prepare(of(replace(schedule, factor=0.25)), {}, resume=True)
    assert folder.record.read_text() == before


@pytest.mark.parametrize("content", ["", "[]", "{}", "5", '{"recipe": 5}', "null", "[" * 10_000])
def test_a_damaged_record_is_one_line(tmp_path, content):
    folder = RunFolder(tmp_path)
    folder.record.write_text(content)
    with pytest.raises(StereoKitError) as caught:
        folder.prepare({"recipe": {}}, {}, resume=True)
    assert "run.json" in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"stereokit": 5},
        {"stereokit": {}},
        {"stereokit": {}, "global_step": "many"},
        {"stereokit": {"ended_by_minutes": "x"}, "global_step": 1},
        {"stereokit": {"ended_by_minutes": float("nan")}, "global_step": 1},
    ],
)
def test_a_damaged_checkpoint_is_one_line(tmp_path, content):
    folder = RunFolder(tmp_path)
    folder.last.parent.mkdir(parents=True)
    torch.save(content, folder.last)
    with pytest.raises(CheckpointError, match=r"last\.ckpt"):
        folder.check_checkpoint(10, 1.0)


def test_a_damaged_record_of_the_best_network_is_one_line(tmp_path):
    folder = RunFolder(tmp_path)
    folder.best.mkdir()
    (folder.best / "training.json").write_text('{"validation": {}}')
    with pytest.raises(CheckpointError, match="remove its folder"):
        folder.best_bad_3()
