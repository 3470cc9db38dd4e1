import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest

from stereokit import ConfigError, InputError
from stereokit.bench import Benchmark, Budget, Row
from stereokit.data import read_image

ROW = Row(
    name="coex",
    backend="eager",
    precision="float32",
    height=384,
    width=1248,
    batch=1,
    max_disparity=192,
    parameters=2_721_993,
    multiply_adds=32_650_000_000,
    first_seconds=3.0,
    peak_memory=600 * 2**20,
    seconds=(0.5, 0.7),
    median_seconds=0.6,
    p95_seconds=0.69,
    pairs_per_second=1 / 0.6,
    ratio=1.0,
    share_of_limit=0.68,
)
FAILED = Row("coex", "onnxruntime", "float32", 384, 1248, 1, None, error="needs the extra 'onnx'")


def benchmark(*rows: Row, budget: Budget | None = None) -> Benchmark:
    machine = {"processor": "a processor", "accelerators": [], "cores": 2, "torch_threads": 1}
    settings = {"device": "cpu", "repeats": 2, "warmup": 1, "seed": 0}
    return Benchmark(rows, budget, settings, machine, {"torch": "2.11"}, "now", (0.5, 1.5), None)


def test_the_table_shows_what_differs_and_the_heading_what_is_shared() -> None:
    both = benchmark(ROW, replace(ROW, precision="bfloat16", ratio=0.5))
    table = both.table()
    assert table.columns[:4] == ("network", "precision", "median [ms]", "p95 [ms]")
    assert table.rows[1][1] == "bfloat16"
    assert table.rows[0][2:] == ("600.0", "690.0", "1.67", "1.00", "600 MiB", "2,721,993", "32.65", "3.00")
    assert "backend eager, size 384 x 1248, batch 1, D 192" in both.heading()
    assert "2 cores, 1 thread, load 0.50 to 1.50" in both.heading()


def test_failures_are_rows_with_their_reason_below() -> None:
    text = str(benchmark(ROW, FAILED))
    assert text.splitlines()[-1] == ("coex onnxruntime float32 384 x 1248, batch 1, D its own: needs the extra 'onnx'")
    [row] = [line for line in text.splitlines() if "onnxruntime" in line and line.endswith("-")]
    assert row.split()[2:] == ["-"] * 9
    assert not benchmark(ROW, FAILED).failed
    assert benchmark(FAILED).failed


def test_limits_and_stages() -> None:
    split = replace(ROW, stages={"feature extraction": 0.1, "rest": 0.05})
    found = benchmark(split, FAILED, budget=Budget("cpu", {"float32": 160e9}, 12e9))
    assert found.table().rows[0][-1] == "68.0 %"
    assert "matrix product 160 GFLOP/s in float32; memory copy 12.0 GB/s" in found.heading()
    stages = found.stage_table()
    assert stages is not None
    assert stages.columns == ("network", "feature extraction", "rest", "sum")
    assert stages.rows == (("coex", "100.0", "50.0", "150.0"),)
    refined = replace(ROW, name="aanet", stages={"feature extraction": 0.1, "refinement": 0.2, "rest": 0.05})
    stages = benchmark(split, refined).stage_table()
    assert stages is not None
    assert stages.columns == ("network", "feature extraction", "refinement", "rest", "sum")
    assert [row[2] for row in stages.rows] == ["-", "200.0"]
    assert benchmark(ROW).stage_table() is None


def test_files_are_whole_and_never_replaced_unasked(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    found = benchmark(ROW, FAILED, replace(ROW, backend="compile"))
    for name, save in (("b.json", found.save), ("b.png", found.save_plot)):
        save(tmp_path / name)
        with pytest.raises(InputError, match=r"exists already"):
            save(tmp_path / name)
        save(tmp_path / name, overwrite=True)
    assert read_image(tmp_path / "b.png").shape[1] > 500
    labels = [label.get_text() for label in found.figure().axes[0].get_yticklabels()]
    assert labels == ["coex eager 192", "coex compile 192"]
    with pytest.raises(ConfigError, match=r"'\.txt'; use \.png"):
        found.save_plot(tmp_path / "b.txt")


def test_a_plot_without_matplotlib_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"stereokit\[viz\]"):
        benchmark(ROW).save_plot(tmp_path / "b.png")
    assert list(tmp_path.iterdir()) == []
