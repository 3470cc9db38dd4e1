from pathlib import Path

import pytest
from torch import nn

from stereokit.registry import MODELS
from tests.cli.commands import fails, run


def test_the_blocks_of_a_network(capsys: pytest.CaptureFixture[str], weights: str) -> None:
    said = run(capsys, "info", "coex", "--size", 64, 96)[1]
    assert "2,721,993" in said
    assert "Hourglass" in said
    assert "max_disparity 64" in run(capsys, "info", weights)[1]
    # no weights are needed, and those that there are may be named
    assert run(capsys, "info", "gcnet", "--size", 64, 96)[1].startswith("gcnet: max_disparity 192")
    assert "2,721,993" in run(capsys, "info", "coex.synthetic_v7", "--size", 64, 96)[1]


def test_bad_input_is_one_line(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "did you mean 'psmnet'" in fails(capsys, "info", "psmnett")
    assert "32 x 32" in fails(capsys, "info", "coex", "--size", 8, 8)
    (tmp_path / "net.onnx").touch()
    assert "net.onnx' is an exported file" in fails(capsys, "info", tmp_path / "net.onnx")
    monkeypatch.setitem(MODELS._factories, "slotless", nn.Identity)
    assert "model 'slotless' is a Identity, not a StereoNetwork" in fails(capsys, "info", "slotless")
