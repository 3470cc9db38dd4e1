import os
import subprocess
import sys
from pathlib import Path

import pytest

from stereokit.cli.program import COMMANDS
from tests.cli.commands import fails, run


def test_unknown_options_are_refused_in_the_name_of_their_command(capsys: pytest.CaptureFixture[str]) -> None:
    said = fails(capsys, "predict", "left.png", "right.png", "--verbose")
    assert said == "stereokit predict: unrecognized arguments: --verbose; see stereokit predict --help\n"
    assert "in quotes" in fails(capsys, "predict", "a.png", "b.png", "c.png", "--verbose")
    assert "in quotes" not in fails(capsys, "predict", "a.png", "b.png", "--zoom", "3")


def test_the_package_runs_as_a_module() -> None:
    command = [sys.executable, "-m", "stereokit", "list", "costs", "*wise*"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "groupwise_correlation\n"), done.stderr


def test_warnings_are_one_line_and_names_are_printable(images: Path, weights: str) -> None:
    odd = os.fsdecode(b"no\xffutf8\x1b[31m.png")
    for view in ("left", "right"):
        (images / view / "b.png").unlink()
        (images / view / "a.png").rename(images / view / odd)
    (images / "right" / odd).write_bytes((images / "left" / odd).read_bytes())
    # a process of its own: the streams of a terminal refuse what is no UTF-8
    command = [sys.executable, "-m", "stereokit", "predict", "left", "right", "--weights", weights, "--device", "cpu"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "PYTHONIOENCODING": "utf-8:strict"}
    done = subprocess.run(command, cwd=images, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "no\\udcffutf8\\x1b[31m: 50 x 40 px" in done.stdout
    assert "\x1b" not in done.stdout
    [line] = [line for line in done.stderr.splitlines() if "are the same" in line]
    assert line.startswith("warning: the left image 'left/no\\udcff")
    assert "UserWarning" not in done.stderr
    assert len(list((images / "disparity").glob("no*"))) == 4


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_every_command_explains_itself(capsys: pytest.CaptureFixture[str], command: list[str]) -> None:
    code, said, _ = run(capsys, *command, "--help")
    assert code == 0
    assert said.startswith(f"usage: {' '.join(['stereokit', *command])} ")
    # two dots are no ellipsis
    assert ".. " not in said.replace("... ", "")
