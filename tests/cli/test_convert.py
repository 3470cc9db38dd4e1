import json
from pathlib import Path

import pytest

from tests.cli.commands import fails, run
from tests.shared import SHARED, needs_shared


def test_a_failed_conversion_leaves_no_folder(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "text.txt").write_text("no checkpoint")
    assert "text.txt" in fails(capsys, "convert", tmp_path / "text.txt", tmp_path / "my")
    assert not (tmp_path / "my").exists()
    assert "it is a file" in fails(capsys, "convert", tmp_path / "text.txt", tmp_path / "text.txt")


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_convert_keeps_existing_files(capsys: pytest.CaptureFixture[str], tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("precious")
    assert "exists already" in fails(capsys, "convert", "weights.ckpt", tmp_path)
    assert (tmp_path / name).read_text() == "precious"


@needs_shared
def test_convert_reports_what_it_dropped(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pilot = SHARED / "golden/coex_pilot.ckpt"
    arguments = ("convert", pilot, tmp_path / "net", "--channel-order", "rgb", "--top-k", 3)
    code, said, _ = run(capsys, *arguments)
    assert code == 0
    assert "cost_agg.conv_up.0.bn.weight" in said
    assert json.loads((tmp_path / "net/config.json").read_text())["network"]["regression"]["k"] == 3
    assert "exists already" in fails(capsys, *arguments)
    assert "--model coex" in fails(capsys, "convert", pilot, tmp_path / "other", "--model", "psmnet")
