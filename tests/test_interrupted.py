"""Commands whose disk is full, or that are killed at the worst moment."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stereokit.data import read_disparity, write_image
from tests.evaluation.scenes import save_scene

FULL = """
import resource, sys
from stereokit.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, ({most}, {most}))
sys.exit(main({arguments}))
"""

KILLED = """
import os, pathlib, signal, sys
from stereokit.cli import main
replace, calls = pathlib.Path.replace, []
def killed(self, target):
    calls.append(target)
    if len(calls) == {at}:
        os.kill(os.getpid(), signal.SIGKILL)
    return replace(self, target)
pathlib.Path.replace = killed
sys.exit(main({arguments}))
"""

posix = pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX limits and signals")


def run(script: str, folder: Path, arguments: list[str], **values: int) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", script.format(arguments=arguments, **values)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
        capture_output=True,
        text=True,
    )


def files(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


@posix
@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ["synth", "--count", "1", "--size", "64", "96", "--out", "out"],
        ["eval", "--model", "sgbm", "--data", "folder:mine", "--out", "out"],
        ["predict", "mine/a/left.png", "mine/a/right.png", "--device", "cpu", "--out", "out"],
        ["train", "--recipe", "synthetic", "--steps", "1", "--batch", "1", "--workers", "0", "--accelerator", "cpu",
         "--out", "out"],
    ],
)  # fmt: skip
def test_a_full_disk_is_one_line_and_leaves_nothing_in_part(tmp_path: Path, arguments: list[str]) -> None:
    save_scene(tmp_path / "mine", "a", 5)
    ended = run(FULL, tmp_path, arguments, most=800)
    assert ended.returncode == 2, ended.stderr[-500:]
    assert "Traceback" not in ended.stderr
    [line] = [line for line in ended.stderr.splitlines() if line.startswith("stereokit ")]
    assert "can't be written" in line or "File too large" in line
    # temporary files would hide behind a dot
    assert not [name for name in files(tmp_path / "out") if Path(name).name.startswith(".")]
    for name in files(tmp_path / "out"):
        if name.endswith(".pfm"):
            read_disparity(tmp_path / "out" / name)


@posix
@pytest.mark.slow
@pytest.mark.parametrize("at", [1, 2, 3])
def test_an_evaluation_that_is_killed_while_it_writes_leaves_whole_files(tmp_path: Path, at: int) -> None:
    save_scene(tmp_path / "mine", "a", 5)
    arguments = ["eval", "--model", "sgbm", "--data", "folder:mine", "--out", "out"]
    ended = run(KILLED, tmp_path, arguments, at=at)
    assert ended.returncode == -signal.SIGKILL
    names = [name for name in files(tmp_path / "out") if not name.startswith(".")]
    assert names == sorted([*["evaluation.json", "datasets.csv", "pairs.csv"][: at - 1], "pairs.part.jsonl"])
    overwrite = ["--overwrite"] if at > 1 else []
    again = run(FULL, tmp_path, [*arguments, *overwrite], most=2**30)
    assert again.returncode == 0, again.stderr[-500:]
    assert "pairs.part.jsonl" not in files(tmp_path / "out")


@posix
@pytest.mark.slow
@pytest.mark.parametrize("at", [1, 2])
def test_a_benchmark_that_is_killed_while_it_writes_leaves_whole_files(tmp_path: Path, at: int) -> None:
    pytest.importorskip("matplotlib")
    arguments = ["bench", "--rival", "sgbm", "--size", "32", "64", "--max-disparity", "32", "--repeats", "1",
                 "--warmup", "1", "--json", "b.json", "--plot", "b.svg"]  # fmt: skip
    ended = run(KILLED, tmp_path, arguments, at=at)
    assert ended.returncode == -signal.SIGKILL, ended.stderr[-500:]
    assert [name for name in files(tmp_path) if not name.startswith(".")] == ["b.json"][: at - 1]
    if at == 2:
        assert len(json.loads((tmp_path / "b.json").read_text())["rows"]) == 1
    overwrite = ["--overwrite"] if at > 1 else []
    again = run(FULL, tmp_path, [*arguments, *overwrite], most=2**30)
    assert again.returncode == 0, again.stderr[-500:]
    assert {"b.json", "b.svg"} <= set(files(tmp_path))


@posix
@pytest.mark.slow
def test_an_export_that_is_killed_between_its_files_is_no_export(tmp_path: Path) -> None:
    pytest.importorskip("openvino")
    arguments = ["export", "--to", "openvino", "--out", "coex.xml", "--size", "64", "96"]
    assert run(FULL, tmp_path, arguments, most=2**30).returncode == 0
    ended = run(KILLED, tmp_path, [*arguments, "--overwrite"], at=2)
    assert ended.returncode == -signal.SIGKILL, ended.stderr[-500:]
    # the weights of now, and no graph that would read them
    assert not (tmp_path / "coex.xml").exists()
    images = np.zeros((64, 96, 3), np.uint8)
    for name in ("left", "right"):
        write_image(tmp_path / f"{name}.png", images)
    after = run(FULL, tmp_path, ["predict", "left.png", "right.png", "--weights", "coex.xml"], most=2**30)
    assert (after.returncode, "does not exist" in after.stderr) == (2, True)
