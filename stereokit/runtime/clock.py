"""Seconds that can be compared: synchronised clocks, warm-up, interleaved rounds."""

import random
import time
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch

__all__ = ["Clock", "Timing", "synchronise", "synchronised_clock", "time_interleaved", "without_traceback"]

Clock = Callable[[], float]
"""Seconds since some moment."""

Key = TypeVar("Key", bound=Hashable)


def synchronise() -> None:
    """Waits until the accelerator, if there is one, has done all that it was given."""
    if torch.accelerator.is_available():
        torch.accelerator.synchronize()


def synchronised_clock() -> float:
    """Seconds since some moment, read when the accelerator has done all that it was given.

    >>> synchronised_clock() <= synchronised_clock()
    True
    """
    synchronise()
    return time.perf_counter()


def without_traceback(error: Exception) -> Exception:
    """The error alone: its traceback would keep alive what the failing functions held, such as images on a GPU."""
    error.__context__ = error.__cause__ = None
    return error.with_traceback(None)


@dataclass(frozen=True)
class Timing:
    """The seconds of several runs of one job.

    >>> timing = Timing((0.2, 0.1, 0.3, 0.2, 0.9))
    >>> timing.median, round(timing.p95, 3)
    (0.2, 0.78)
    """

    seconds: tuple[float, ...]

    @property
    def median(self) -> float:
        """Half of the runs took less."""
        return float(np.median(self.seconds))

    @property
    def p95(self) -> float:
        """95 of 100 runs took less; between two runs, interpolated linearly."""
        return float(np.percentile(self.seconds, 95))


def time_interleaved(
    jobs: Mapping[Key, Callable[[], object]],
    *,
    repeats: int,
    seed: int = 0,
    clock: Clock = synchronised_clock,
    progress: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> dict[Key, Timing | Exception]:
    """Times jobs in rounds: in each of them every job runs once, in an order that is drawn anew.

    Whatever slows the machine for a while then slows all jobs alike, and none always comes after the same other one.

    Args:
        jobs: what to run, warmed up.
        repeats: the number of rounds.
        seed: of the orders.
        clock: is read right before and right after each run.
        progress: wraps the rounds, such as `tqdm`.

    Returns:
        For each job, in their order, its times; or what it raised, after which it is left out.

    >>> timings = time_interleaved({"quick": lambda: None, "broken": lambda: 1 / 0}, repeats=3)
    >>> len(timings["quick"].seconds), timings["broken"]
    (3, ZeroDivisionError('division by zero'))
    """
    order = list(jobs)
    draw = random.Random(seed)
    seconds: dict[Key, list[float]] = {key: [] for key in order}
    failures: dict[Key, Exception] = {}
    for _ in progress(range(repeats)):
        draw.shuffle(order)
        for key in order:
            if key in failures:
                continue
            try:
                start = clock()
                jobs[key]()
                seconds[key].append(clock() - start)
            except Exception as error:
                # one job that runs out of memory is no reason to lose the others
                failures[key] = without_traceback(error)
    return {key: failures[key] if key in failures else Timing(tuple(seconds[key])) for key in jobs}
