import threading
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereokit.batch.pipeline import read_ahead, run_pipeline
from stereokit.errors import InputError


class Stages:
    """Items are numbers; those in a stage's set fail there."""

    def __init__(self, broken=((), (), ())):
        self.broken = broken
        self.told = []
        self.lock = threading.Lock()
        self.begun = self.ended = self.most = 0

    def run(self, count, **how):
        run_pipeline(range(count), read=self.read, compute=self.compute, write=self.write, tell=self.tell, **how)
        return self.told

    def read(self, item):
        with self.lock:
            self.begun += 1
            self.most = max(self.most, self.begun - self.ended)
        return self._step(0, item, item)

    def compute(self, item, read):
        return self._step(1, item, 2 * read)

    def write(self, item, computed):
        return self._step(2, item, computed + 1)

    def tell(self, item, outcome):
        self.ended += 1
        self.told.append((item, str(outcome)))

    def _step(self, stage, item, value):
        if item in self.broken[stage]:
            raise InputError(f"{item} fails in stage {stage}")
        return value


FAILING = st.sets(st.integers(0, 12), max_size=4)


@given(st.tuples(FAILING, FAILING, FAILING), st.integers(0, 12), st.integers(1, 4), st.integers(1, 5))
@settings(deadline=None)
def test_any_number_of_workers_does_what_none_does(broken, count, workers, ahead):
    alone = Stages(broken).run(count, workers=0)
    assert [item for item, _ in alone] == list(range(count))
    assert Stages(broken).run(count, workers=workers, ahead=ahead) == alone


@pytest.mark.parametrize("slow", ["read", "compute", "write"])
def test_few_items_are_held_at_a_time(slow, monkeypatch):
    stages = Stages()
    quick = getattr(stages, slow)
    monkeypatch.setattr(stages, slow, lambda *given: time.sleep(0.002) or quick(*given))
    stages.run(60, workers=2, ahead=3)
    assert stages.begun == stages.ended == 60
    # three wait before the middle stage and three after it
    assert 3 <= stages.most <= 3 + 1 + 3


def test_the_stages_overlap():
    together = threading.Barrier(3, timeout=30)

    def meet(*given):
        together.wait()

    # each waits until one item is read, one computed and one written at the same time
    items = iter(range(5))
    run_pipeline(
        items,
        read=lambda item: meet() if item > 1 else None,
        compute=lambda item, read: meet() if 0 < item < 4 else None,
        write=lambda item, computed: meet() if item < 3 else None,
        tell=lambda item, outcome: None,
        workers=1,
    )


@pytest.mark.parametrize("stage", ["read", "compute", "write", "tell"])
@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
@pytest.mark.parametrize("workers", [0, 2])
def test_what_ends_the_loop_is_raised_and_what_was_computed_is_told(stage, error, workers, monkeypatch):
    stages = Stages()
    quick = getattr(stages, stage)

    def end(item, *given):
        if item == 5:
            raise error
        return quick(item, *given)

    monkeypatch.setattr(stages, stage, end)
    with pytest.raises(error):
        stages.run(100, workers=workers, ahead=4)
    told = [item for item, _ in stages.told if item != 5]
    assert told == sorted(told)
    assert {0, 1, 2, 3, 4} <= set(told)
    assert stages.begun < 20


def test_items_are_asked_for_as_they_are_needed():
    asked = []
    given = (asked.append(number) or number for number in range(100))
    results = read_ahead(given, lambda number: -number, workers=2, ahead=3)
    assert [next(results), next(results)] == [0, -1]
    assert len(asked) <= 5
    results.close()
    assert len(asked) <= 5


@pytest.mark.parametrize("workers", [0, 2])
def test_reading_ahead_fails_in_turn(workers):
    results = read_ahead(range(5), lambda number: 1 // (number - 2), workers=workers)
    assert [next(results), next(results)] == [-1, -1]
    with pytest.raises(ZeroDivisionError):
        next(results)
