from pathlib import Path

import numpy as np
import pytest

from stereokit.data import write_image
from tests.cli.commands import fails, run
from tests.evaluation.scenes import save_scene


def test_check_reports_and_fails_where_pairs_are_broken(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_scene(tmp_path / "mine", "a", 5)
    save_scene(tmp_path / "mine", "b", 9, seed=1)
    monkeypatch.chdir(tmp_path)
    code, said, shown = run(capsys, "data", "check", "folder", "mine")
    assert code == 0
    assert "pairs             2" in said
    assert "broken            0" in said
    assert "2/2" in shown
    Path("mine/b/right.png").unlink()
    write_image("mine/a/right.png", np.zeros((5, 5, 3), np.uint8), overwrite=True)
    code, said, shown = run(capsys, "data", "check", "folder", "mine")
    assert code == 2
    assert "broken            2" in said
    assert "right.png' does not exist" in said
    assert "2 of 2 pairs are broken" in shown.splitlines()[-1]
    assert "did you mean 'folder'" in fails(capsys, "data", "check", "foldr", "mine")
