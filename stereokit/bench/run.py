"""Runs a benchmark: prepares every candidate, times them in turns, and writes down what was found."""

import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import nn

from stereokit.bench.budget import Budget, measure_budget
from stereokit.bench.candidates import Candidate, image_pair
from stereokit.bench.report import Benchmark, Row
from stereokit.bench.stages import StageClock
from stereokit.bench.summary import model_summary
from stereokit.errors import ConfigError, InputError
from stereokit.network import StereoNetwork
from stereokit.optimize import PreparedNetwork
from stereokit.runtime.clock import Clock, Timing, synchronised_clock, time_interleaved, without_traceback
from stereokit.runtime.memory import available_memory, estimate_memory, format_memory, hand_back_memory
from stereokit.runtime.memory.peak import PeakMemory
from stereokit.runtime.provenance import machine, versions

__all__ = ["run_benchmark"]

Progress = Callable[[Iterable[Any]], Iterable[Any]]


@dataclass
class _Prepared:
    """A candidate that has run already."""

    run: Callable[[], object]
    network: StereoNetwork | None
    parameters: int | None
    multiply_adds: int | None
    first_seconds: float
    peak_memory: int | None
    max_disparity: int | None
    iterations: int | None


def run_benchmark(
    candidates: Sequence[Candidate],
    *,
    device: str | torch.device = "cpu",
    repeats: int = 20,
    warmup: int = 3,
    seed: int = 0,
    stages: bool = False,
    budget: bool = False,
    command: str | None = None,
    progress: Progress = iter,
    clock: Clock = synchronised_clock,
) -> Benchmark:
    """Times candidates against each other.

    Each candidate is built and run `warmup` times, the last time for its peak memory. Then they run in turns, each
    round in another order. Timed is the network on images that lie on the device already, until the device is done;
    reading images, and copies to and from the device, are not. A candidate that fails is a row that says why.

    Args:
        candidates: what is timed; the others are compared with the first.
        device: for all of them.
        repeats: how often each is timed.
        warmup: untimed runs of each beforehand, at least 1.
        seed: of the order in the rounds.
        stages: split networks that run operation by operation into their stages, in as many runs more.
        budget: measure what the hardware can do, before anything else.
        command: the command line, for the record.
        progress: wraps what takes long, such as `tqdm`.
        clock: waits for the device.

    Raises:
        InputError: there is nothing to time.

    >>> from stereokit.bench import source_of
    >>> candidate = Candidate("coex", source_of("coex"), height=32, width=64, max_disparity=32)
    >>> benchmark = run_benchmark([candidate], repeats=2, warmup=1)
    >>> benchmark.rows[0].error is None, len(benchmark.rows[0].seconds)
    (True, 2)
    """
    if not candidates or repeats < 1 or warmup < 1:
        raise InputError(
            f"{len(candidates)} candidates, {repeats} repeats and {warmup} runs to warm up; expected at least 1 of each"
        )
    device = torch.device(device)
    started, load = datetime.now(timezone.utc).isoformat(timespec="seconds"), [_load()]
    precisions = list(dict.fromkeys(candidate.precision for candidate in candidates if candidate.backend != "opencv"))
    prepared: dict[int, _Prepared] = {}
    failures: dict[int, Exception] = {}
    with torch.inference_mode(), ExitStack() as stack:
        if device.type != "cpu" and device.index is not None:
            # clocks wait for the current one
            stack.enter_context(torch.accelerator.device_index(device.index))
        limits = measure_budget(device, precisions, clock=clock) if budget else None
        for index, candidate in enumerate(progress(candidates)):
            folder = stack.enter_context(TemporaryDirectory(prefix="stereokit-"))
            try:
                prepared[index] = _prepare(candidate, device, warmup, clock, folder)
            except Exception as error:
                # a network, a compiler or a driver of anybody's
                failures[index] = without_traceback(error)
        jobs = {index: ready.run for index, ready in prepared.items()}
        timings = time_interleaved(jobs, repeats=repeats, seed=seed, clock=clock, progress=progress)
        failures |= {index: timing for index, timing in timings.items() if isinstance(timing, Exception)}
        splits = _split(candidates, prepared, failures, repeats, clock) if stages else {}
    load.append(_load())

    per_pair = (t.median / candidates[i].batch for i, t in timings.items() if isinstance(t, Timing))
    first = next(per_pair, None)
    rows = []
    for index, candidate in enumerate(candidates):
        row = _row(candidate, prepared.get(index), failures.get(index))
        timing = timings.get(index)
        if isinstance(timing, Timing) and first is not None:
            row = _with_times(row, timing, first, splits.get(index), limits)
        rows.append(row)
    return Benchmark(
        rows=tuple(rows),
        budget=limits,
        settings={"device": str(device), "repeats": repeats, "warmup": warmup, "seed": seed},
        machine=machine(),
        versions=versions(),
        started=started,
        load=tuple(load),
        command=command,
    )


def _prepare(candidate: Candidate, device: torch.device, warmup: int, clock: Clock, folder: str) -> _Prepared:
    network = candidate.build()
    parameters = multiply_adds = None
    if isinstance(network, nn.Module):
        parameters = sum(p.numel() for p in network.parameters())
        _check_memory(network.to(device), candidate, device)
    if isinstance(network, StereoNetwork):
        blocks = model_summary(network, candidate.height, candidate.width)
        multiply_adds = candidate.batch * sum(block.multiply_adds for block in blocks)
    max_disparity = getattr(network, "max_disparity", getattr(network, "search_range", None))
    iterations = getattr(network, "test_iterations", None)
    # from here on, with all imports done, the memory is the candidate's own
    del network
    images = image_pair(candidate, device)
    start = clock()
    # what writing a file takes is not what running it takes
    file = candidate.export(folder)
    seconds_to_export = clock() - start
    peak = PeakMemory(device)
    start = clock()
    ready = candidate.ready(candidate.build() if file is None else file, device)

    def run() -> object:
        return ready(*images)

    run()
    first_seconds = seconds_to_export + clock() - start
    for _ in range(warmup - 2):
        run()
    if warmup > 1:
        # where a CUDA graph is played again nothing is taken: it was when it was recorded
        if not (device.type == "cuda" and candidate.backend == "compile"):
            peak.restart()
        run()
    inner = ready.network if isinstance(ready, PreparedNetwork) else ready
    return _Prepared(
        run=run,
        network=inner if isinstance(inner, StereoNetwork) else None,
        parameters=parameters,
        multiply_adds=multiply_adds,
        first_seconds=first_seconds,
        peak_memory=peak.bytes(),
        max_disparity=max_disparity,
        iterations=iterations,
    )


def _check_memory(network: nn.Module, candidate: Candidate, device: torch.device) -> None:
    """The system would end the whole process where memory runs out."""
    hand_back_memory()
    available = available_memory(device)
    try:
        needed = estimate_memory(network, candidate.height, candidate.width, batch=candidate.batch)
    except ConfigError:
        return
    if available is not None and needed > available:
        raise InputError(
            f"needs about {format_memory(needed)} of memory, {format_memory(available)} are free on {device}"
        )


def _split(
    candidates: Sequence[Candidate],
    prepared: dict[int, _Prepared],
    failures: dict[int, Exception],
    repeats: int,
    clock: Clock,
) -> dict[int, dict[str, float]]:
    """The median seconds of each stage of the networks that run operation by operation, in rounds too."""
    clocks = {
        index: StageClock(ready.network, clock=clock)
        for index, ready in prepared.items()
        if ready.network is not None and index not in failures
    }

    def watched(index: int) -> Callable[[], object]:
        def run() -> object:
            with clocks[index]:
                return prepared[index].run()

        return run

    outcomes = time_interleaved({index: watched(index) for index in clocks}, repeats=repeats, clock=clock)
    return {
        index: {stage: float(np.median([p[stage] for p in split.passes])) for stage in split.passes[0]}
        for index, split in clocks.items()
        if isinstance(outcomes[index], Timing)
    }


def _row(candidate: Candidate, ready: _Prepared | None, failure: Exception | None) -> Row:
    measured: dict[str, Any] = {"max_disparity": candidate.max_disparity, "iterations": candidate.iterations}
    if ready is not None:
        measured = {
            "max_disparity": ready.max_disparity,
            "iterations": ready.iterations,
            "parameters": ready.parameters,
            "multiply_adds": ready.multiply_adds,
            "first_seconds": ready.first_seconds,
            "peak_memory": ready.peak_memory,
        }
    return Row(
        name=candidate.name,
        backend=candidate.backend,
        precision=candidate.precision,
        height=candidate.height,
        width=candidate.width,
        batch=candidate.batch,
        error=None if failure is None else _one_line(failure),
        **measured,
    )


def _with_times(row: Row, timing: Timing, first: float, stages: dict[str, float] | None, limits: Budget | None) -> Row:
    share = None
    if limits is not None and row.multiply_adds is not None:
        share = limits.share(row.multiply_adds, timing.median, row.precision)
    return replace(
        row,
        seconds=timing.seconds,
        median_seconds=timing.median,
        p95_seconds=timing.p95,
        pairs_per_second=row.batch / timing.median,
        ratio=timing.median / row.batch / first,
        share_of_limit=share,
        stages=stages,
    )


def _one_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    said = lines[0] if lines else type(error).__name__
    return said if isinstance(error, (ConfigError, InputError)) else f"{type(error).__name__}: {said}"


def _load() -> float | None:
    """How many processes want to run, on average over the last minute."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
