import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from stereokit import ConfigError, InputError, StereoOutput, build_model
from stereokit.bench import Candidate, run_benchmark, source_of
from stereokit.bench import run as module
from stereokit.bench.candidates import BACKENDS, EXPORTS

NOW = [0.0]


def clock() -> float:
    return NOW[0]


class Takes(nn.Module):
    """A network that takes as long as it says."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(5))
        self.seconds = seconds

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        NOW[0] += self.seconds
        return StereoOutput(left[:, 0].float())


def takes(seconds: float, backend: str = "eager", **place: Any) -> Candidate:
    return Candidate(f"takes {seconds}", partial(Takes, seconds), backend, height=32, width=64, **place)


class Breaks(Takes):
    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        raise torch.OutOfMemoryError("out of memory\nand much more")


def test_times_rates_and_ratios() -> None:
    rows = run_benchmark([takes(0.25), takes(0.5), takes(0.5, batch=4)], repeats=4, clock=clock).rows
    assert [row.median_seconds for row in rows] == [0.25, 0.5, 0.5]
    assert [row.seconds for row in rows] == [(0.25,) * 4, (0.5,) * 4, (0.5,) * 4]
    assert [row.pairs_per_second for row in rows] == [4, 2, 8]
    assert [row.ratio for row in rows] == [1, 2, 0.5]
    assert [row.parameters for row in rows] == [5, 5, 5]
    assert [row.first_seconds for row in rows] == [0.25, 0.5, 0.5]
    assert all(row.multiply_adds is None and row.stages is None and row.error is None for row in rows)


def test_warming_up_is_not_timed() -> None:
    counts = []

    class Counts(Takes):
        def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
            counts.append(1)
            self.seconds = 9 if len(counts) <= self.slow else 1
            return super().forward(left, right)

        slow = 0

    for warmup in (1, 2, 5):
        counts.clear()
        # one more, of the tensors without data that the memory is estimated from
        Counts.slow = warmup + 1
        [row] = run_benchmark([Candidate("c", partial(Counts, 1), "eager")], repeats=3, warmup=warmup, clock=clock).rows
        assert row.seconds == (1, 1, 1)
        assert len(counts) == warmup + 1 + 3


def test_failures_are_rows_and_the_first_that_works_is_the_measure() -> None:
    missing = Candidate("other", partial(Takes, 1.0), backend="none such")
    rows = run_benchmark([Candidate("breaks", partial(Breaks, 1)), missing, takes(2.0)], repeats=2, clock=clock).rows
    assert rows[0].error == "OutOfMemoryError: out of memory"
    assert rows[1].error is not None
    assert "unknown backend 'none such'" in rows[1].error
    assert rows[2].error is None
    assert rows[2].ratio == 1
    assert not run_benchmark([takes(1.0)], repeats=1, clock=clock).failed
    assert run_benchmark([missing], repeats=1, clock=clock).failed


def test_a_backend_that_is_not_installed_says_so_in_its_row(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(network: Any, candidate: Candidate, device: torch.device) -> Any:
        raise ConfigError("needs the extra 'onnx': pip install 'stereokit[onnx]'")

    monkeypatch.setattr("stereokit.bench.candidates.BACKENDS", {**BACKENDS, "absent": absent})
    [row] = run_benchmark([takes(1.0, backend="absent")], repeats=1, clock=clock).rows
    assert row.error == "needs the extra 'onnx': pip install 'stereokit[onnx]'"


def test_what_memory_can_not_hold_is_not_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "available_memory", lambda device: 1000)
    [row] = run_benchmark([takes(1.0)], repeats=1, clock=clock).rows
    assert row.error is not None
    assert "are free on cpu" in row.error


@pytest.mark.slow
def test_stages_share_and_counts_of_a_network() -> None:
    place = {"height": 32, "width": 64, "max_disparity": 32}
    candidates = [
        Candidate("coex", source_of("coex"), **place),
        Candidate("twice", source_of("coex"), batch=2, **place),
    ]
    benchmark = run_benchmark(candidates, repeats=2, warmup=1, stages=True, budget=True)
    one, two = benchmark.rows
    assert one.parameters == sum(p.numel() for p in build_model("coex").parameters())
    assert one.multiply_adds is not None
    assert two.multiply_adds == 2 * one.multiply_adds
    assert one.max_disparity == 32
    assert one.stages is not None
    assert list(one.stages)[:2] == ["feature extraction", "cost volume"]
    assert benchmark.budget is not None
    limit = benchmark.budget.share(one.multiply_adds, one.median_seconds or 0, "float32")
    assert one.share_of_limit == limit
    record = json.loads(benchmark.to_json())
    assert {"machine", "versions", "load", "settings", "started", "command"} < set(record)
    assert record["rows"][0]["seconds"] == list(one.seconds)


def test_a_network_composed_by_hand_is_timed_and_counted() -> None:
    def composed() -> nn.Module:
        model = build_model("coex", max_disparity=32)
        model._config = None
        return model

    [row] = run_benchmark([Candidate("mine", composed, height=32, width=64)], repeats=1, warmup=1).rows
    assert row.error is None
    assert row.multiply_adds is not None
    assert row.max_disparity == 32


@pytest.mark.parametrize("has", ["float32", "bfloat16"])
def test_a_runtime_that_computes_in_another_precision_is_not_timed(monkeypatch: pytest.MonkeyPatch, has: str) -> None:
    def export(candidate: Candidate, folder: str) -> Path:
        path = Path(folder) / "network.xml"
        path.touch()
        return path

    class Runtime:
        precision = has

        def __init__(self, path: Path, device: torch.device) -> None:
            assert path.exists()

        def __call__(self, left: Tensor, right: Tensor) -> None:
            NOW[0] += 3

    monkeypatch.setitem(EXPORTS, "openvino", export)  # type: ignore[arg-type]
    monkeypatch.setattr("stereokit.bench.candidates.open_backend", Runtime)
    [row] = run_benchmark([takes(1.0, "openvino", precision="bfloat16")], repeats=2, clock=clock).rows
    if has == "bfloat16":
        assert row.median_seconds == 3
    else:
        assert row.error == "openvino computes in float32 here, not in bfloat16"


def test_nothing_to_time_is_an_error() -> None:
    for wrong in ({"repeats": 0}, {"warmup": 0}):
        with pytest.raises(InputError, match=r"at least 1 of each"):
            run_benchmark([takes(1.0)], **wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"0 candidates"):
        run_benchmark([])
