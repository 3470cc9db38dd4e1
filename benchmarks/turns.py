"""Forms of one job, each in a process of its own, that take turns: what else runs disturbs all of them alike."""

import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from stereokit.runtime.clock import synchronised_clock

# what passes on the wall, and what the processor's cores spend together; the second is less disturbed by others
CLOCKS = (synchronised_clock, time.process_time)


def take_turns(
    forms: Sequence[str], rounds: int, arguments: Callable[[str], list[str]]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Runs this script once per form, with further arguments; each has to call `serve`.

    Returns:
        What each form reported, and the median seconds of each by the two clocks.
    """
    workers, reports = {}, {}
    times: dict[str, list[list[float]]] = {form: [] for form in forms}
    for form in forms:
        command = [sys.executable, *sys.argv, *arguments(form)]
        workers[form] = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        # one after the other, so that compilation is timed on its own
        reports[form] = json.loads(workers[form].stdout.readline())
    for _ in range(rounds):
        for form, worker in workers.items():
            worker.stdin.write("\n")
            worker.stdin.flush()
            times[form].append(json.loads(worker.stdout.readline()))
    for worker in workers.values():
        worker.stdin.close()
        worker.wait()
    return reports, {form: np.median(turns, axis=0) for form, turns in times.items()}


def serve(report: Any, run: Callable[[], object]) -> None:
    """Says that this form is ready; then, for each line of input, runs it once untimed and once timed."""
    print(json.dumps(report), flush=True)
    for _ in sys.stdin:
        run()
        starts = [clock() for clock in CLOCKS]
        run()
        print(json.dumps([clock() - start for clock, start in zip(CLOCKS, starts, strict=True)]), flush=True)
