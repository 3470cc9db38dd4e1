import pytest

from tests.cli.commands import fails, run


def test_names_of_one_slot_or_of_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(capsys, "list", "models", "psm*")[1] == "psmnet\n"
    assert "groupwise_correlation" in run(capsys, "list")[1]
    assert "no costs match 'x*'; there are combined, concatenation, correlation" in fails(capsys, "list", "costs", "x*")
    assert "did you mean 'costs'" in fails(capsys, "list", "cost")
