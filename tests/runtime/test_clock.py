from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereokit.runtime.clock import Timing, time_interleaved


class FakeClock:
    """Moves on only when told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def job(self, seconds: float, log: list[str] | None = None, name: str = "") -> Callable[[], None]:
        def run() -> None:
            self.now += seconds
            if log is not None:
                log.append(name)

        return run


@given(st.lists(st.floats(1e-6, 1e3), min_size=1, max_size=50))
def test_median_and_95th_percentile(seconds: list[float]) -> None:
    timing = Timing(tuple(seconds))
    # half of the runs, and 95 of 100, took no longer
    assert np.mean(np.array(seconds) <= timing.median * (1 + 1e-12)) >= 0.5
    assert min(seconds) <= timing.median <= timing.p95 * (1 + 1e-12) <= max(seconds) * (1 + 1e-9)


def test_percentiles_of_known_times() -> None:
    timing = Timing(tuple(range(1, 102)))
    assert timing.median == 51
    assert timing.p95 == 96


def test_each_job_is_timed_in_every_round_by_the_given_clock() -> None:
    clock = FakeClock()
    log: list[str] = []
    jobs = {name: clock.job(seconds, log, name) for name, seconds in {"a": 1.0, "b": 2.0, "c": 4.0}.items()}
    timings = time_interleaved(jobs, repeats=30, clock=clock)
    assert timings == {"a": Timing((1.0,) * 30), "b": Timing((2.0,) * 30), "c": Timing((4.0,) * 30)}
    rounds = [tuple(log[i : i + 3]) for i in range(0, 90, 3)]
    assert all(sorted(names) == ["a", "b", "c"] for names in rounds)
    # no job always comes after the same one
    assert len(set(rounds)) == 6
    again: list[str] = []
    time_interleaved({name: clock.job(1, again, name) for name in jobs}, repeats=30, clock=clock)
    assert again == log


def test_a_job_that_fails_does_not_take_the_others_with_it() -> None:
    clock = FakeClock()
    calls = []

    def fails_in_the_third_round() -> None:
        calls.append(1)
        if len(calls) == 3:
            raise MemoryError("full")

    timings = time_interleaved({"bad": fails_in_the_third_round, "good": clock.job(1)}, repeats=5, clock=clock)
    assert isinstance(timings["bad"], MemoryError)
    # it would keep alive what the job held
    assert timings["bad"].__traceback__ is None
    assert timings["good"] == Timing((1.0,) * 5)
    assert len(calls) == 3


def test_the_rounds_can_be_watched() -> None:
    seen = []
    time_interleaved({"a": lambda: None}, repeats=4, progress=lambda rounds: (seen.append(r) or r for r in rounds))
    assert seen == [0, 1, 2, 3]


def test_a_keyboard_interrupt_ends_all() -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        time_interleaved({"a": interrupt}, repeats=2)
