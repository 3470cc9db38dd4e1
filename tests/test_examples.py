import runpy
import sys
from pathlib import Path

import pytest

from stereokit.registry import COSTS, GUIDANCE, MODELS

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"

SAYS = {
    "drop_in": "mean loss of the first ten steps",
    "new_components": "guidance {'name': 'gain'}: disparity (1, 120, 200)",
    "own_network": "is the same network when it is loaded",
}
"""A sentence of each example that only a whole run prints."""


def test_every_example_is_run() -> None:
    # the node needs ROS; tests/ros holds its arithmetic to account
    assert {path.stem for path in EXAMPLES.glob("*.py")} - {"ros2_node"} == set(SAYS)


@pytest.mark.parametrize("name", SAYS)
def test_examples_run(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    # what an example registers is forgotten again
    for registry in (COSTS, GUIDANCE, MODELS):
        monkeypatch.setattr(registry, "_factories", dict(registry._factories))
    monkeypatch.setattr(sys, "argv", [name])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert SAYS[name] in capsys.readouterr().out
