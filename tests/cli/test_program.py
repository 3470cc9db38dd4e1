import os
import subprocess
import sys

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


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_every_command_explains_itself(capsys: pytest.CaptureFixture[str], command: list[str]) -> None:
    code, said, _ = run(capsys, *command, "--help")
    assert code == 0
    assert said.startswith(f"usage: {' '.join(['stereokit', *command])} ")
    # two dots are no ellipsis
    assert ".. " not in said.replace("... ", "")
