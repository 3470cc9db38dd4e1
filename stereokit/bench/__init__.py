"""Benchmarks that can be trusted: synchronised clocks, interleaved runs, medians, and what the hardware could do."""

from stereokit.bench.budget import Budget, measure_budget
from stereokit.bench.candidates import BACKENDS, Candidate, rival_source, source_of
from stereokit.bench.report import Benchmark, Row
from stereokit.bench.run import run_benchmark
from stereokit.bench.stages import StageClock
from stereokit.runtime.clock import Timing, synchronised_clock, time_interleaved
from stereokit.runtime.memory.peak import PeakMemory

__all__ = [
    "BACKENDS",
    "Benchmark",
    "Budget",
    "Candidate",
    "PeakMemory",
    "Row",
    "StageClock",
    "Timing",
    "measure_budget",
    "rival_source",
    "run_benchmark",
    "source_of",
    "synchronised_clock",
    "time_interleaved",
]
