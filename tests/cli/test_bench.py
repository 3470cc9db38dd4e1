import json
from pathlib import Path

import pytest

from stereokit.cli import main
from tests.cli.commands import fails, run

QUICK = ("--size", 32, 64, "--max-disparity", 32, "--repeats", 1, "--warmup", 1)


def test_networks_sizes_and_rivals_in_one_table(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    files = ("--json", tmp_path / "b.json", "--plot", tmp_path / "b.svg")
    more = ("--size", 64, 64, "--rival", "sgbm", "--threads", 1, "--stages")
    code, said, _ = run(capsys, "bench", "coex", *QUICK, *more, *files, "--device", "cpu")
    assert code == 0
    record = json.loads((tmp_path / "b.json").read_text())
    rows = [(row["name"], row["backend"], row["precision"], row["height"]) for row in record["rows"]]
    assert rows == [
        ("coex", "torch", "float32", 32),
        ("sgbm", "opencv", "uint8", 32),
        ("coex", "torch", "float32", 64),
        ("sgbm", "opencv", "uint8", 64),
    ]
    assert all(row["median_seconds"] > 0 and row["max_disparity"] == 32 for row in record["rows"])
    assert record["machine"]["torch_threads"] == 1
    assert record["command"].startswith("stereokit bench coex")
    assert "milliseconds by stage" in said
    assert (tmp_path / "b.svg").stat().st_size > 1000


@pytest.mark.slow
def test_iterations_are_rows(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    size = ("--size", 32, 64, "--max-disparity", 64, "--repeats", 1, "--warmup", 1, "--device", "cpu")
    networks = ("rt_igev", "coex")
    file = tmp_path / "b.json"
    code, said, _ = run(capsys, "bench", *networks, *size, "--iterations", 1, 2, "--json", file)
    assert code == 0
    rows = json.loads(file.read_text())["rows"]
    assert [row["iterations"] for row in rows] == [1, 2, 1, 2]
    assert [row["error"] for row in rows[:2]] == [None, None]
    assert rows[0]["multiply_adds"] < rows[1]["multiply_adds"]
    assert all("has no iterations" in row["error"] for row in rows[2:])
    assert "iterations" in said


def test_one_failing_candidate_is_a_row_and_all_are_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    # 33 is no D of CoEx; SGBM takes any
    odd = ("--size", 32, 64, "--max-disparity", 33, "--repeats", 1, "--warmup", 1)
    code, said, _ = run(capsys, "bench", "coex", "--rival", "sgbm", *odd, "--device", "cpu")
    assert code == 0
    assert "not timed\ncoex torch float32 32 x 64, batch 1, D 33: max_disparity 33 is not" in said
    assert "nothing could be timed: coex torch: max_disparity 33" in fails(capsys, "bench", "coex", *odd)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("coexx",), "did you mean 'coex'"),
        (
            ("coex.onnx",),
            "holds no torch module; use stereokit bench NETWORK --backend onnxruntime",
        ),
        (
            ("coex.xml",),
            "holds no torch module; use stereokit bench NETWORK --backend openvino",
        ),
        (("--backend", "compil"), "did you mean 'compile'"),
        (("--precision", "float61"), "did you mean 'float16'"),
        (("--rival", "sgm"), "did you mean 'sgbm'"),
        (("--size", "31", "64"), "31 64 is below 32 x 32"),
        (("--batch", "0"), "--batch 0"),
        (("--threads", "0"), "--threads 0"),
        (("--repeats", "0"), "at least 1 of each"),
        (("--plot", "x.txt"), ".png"),
        (("--json", "nowhere/x.json"), "'nowhere' does not exist"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_timed(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("coex.onnx", "coex.xml"):
        Path(name).touch()
    assert message in fails(capsys, "bench", *arguments)


def test_existing_files_are_kept(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "b.json").write_text("precious")
    assert "exists already" in fails(capsys, "bench", *QUICK, "--json", tmp_path / "b.json")
    assert (tmp_path / "b.json").read_text() == "precious"


def test_the_help_names_what_can_be_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["bench", "--help"])
    said = capsys.readouterr().out
    assert all(word in said for word in ("compile", "bfloat16", "sgbm_5paths", "untrained"))
    assert "opencv" not in said
