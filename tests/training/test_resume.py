from dataclasses import replace

import pytest

from stereokit.errors import ConfigError
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
