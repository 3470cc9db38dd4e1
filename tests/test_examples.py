import runpy
import sys
from pathlib import Path

import pytest

from stereokit.registry import COSTS, GUIDANCE

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


@pytest.mark.parametrize("name", [path.stem for path in EXAMPLES.glob("*.py")])
def test_examples_run(name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    # what an example registers is forgotten again
    for registry in (COSTS, GUIDANCE):
        monkeypatch.setattr(registry, "_factories", dict(registry._factories))
    monkeypatch.setattr(sys, "argv", [name])
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert "disparity (1, 120, 200)" in (said := capsys.readouterr().out) or "mean loss of the first" in said
