"""Benchmarks that can be trusted: synchronised clocks, interleaved runs, medians, and what the hardware could do."""

from stereokit.benchmark.budget import Budget, measure_budget
from stereokit.benchmark.candidates import BACKENDS, Candidate, rival_source, source_of
from stereokit.benchmark.memory import PeakMemory
from stereokit.benchmark.report import Benchmark, Row
from stereokit.benchmark.run import run_benchmark
from stereokit.benchmark.stages import StageClock
from stereokit.clock import Timing, synchronised_clock, time_interleaved

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
