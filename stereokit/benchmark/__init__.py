"""Benchmarks that can be trusted: synchronised clocks, interleaved runs, medians, and what the hardware could do."""
