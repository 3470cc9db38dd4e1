import csv
import json
from pathlib import Path

import numpy as np
import pytest

from stereokit.data import read_kitti_png, write_disparity
from tests.cli.commands import fails, run
from tests.evaluation.scenes import SIZE, save_kitti, save_scene
from tests.shared import SHARED, needs_shared


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with two scenes of one's own, KITTI 2012 for training and KITTI 2015 for testing."""
    save_scene(tmp_path / "mine", "a", 5)
    save_scene(tmp_path / "mine", "b", 9, seed=1)
    save_kitti(tmp_path / "kitti", "2012", "training")
    save_kitti(tmp_path / "kitti15", "2015", "testing", [4])
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_network_on_several_data_sets(capsys: pytest.CaptureFixture[str], here: Path, weights: str) -> None:
    data = ("--data", "folder:mine", "--data", "kitti2012:kitti")
    options = ("--weights", weights, "--device", "cpu", "--batch", 2, "--max-disparity", 60)
    code, said, shown = run(capsys, "eval", "--model", "coex", *options, *data)
    assert code == 0
    assert "folder:mine: split all, 2 pairs, median" in said
    assert "kitti2012:kitti: split training, 2 pairs, median" in said
    assert "non-occluded, per image" in said
    assert "Out-Noc" in said
    assert "2/2" in shown
    record = json.loads((here / "evaluation/evaluation.json").read_text())
    assert record["model"]["configuration"]["name"] == "coex"
    assert record["model"]["weights"] == weights
    assert len(record["model"]["weights_file_sha256"]) == 64
    assert record["settings"]["batch"] == 2
    assert record["command"].startswith(f"stereokit eval --model coex --weights {weights} --device cpu --batch 2")
    with (here / "evaluation/pairs.csv").open(newline="") as file:
        assert [row["pair"] for row in csv.DictReader(file)] == ["a", "b", "000000_10", "000001_10"]
    with (here / "evaluation/datasets.csv").open(newline="") as file:
        epe = [float(row["epe"]) for row in csv.DictReader(file)]
    assert all(f"{value:.2f}" in said for value in epe)


def test_large_pairs_are_matched_as_predict_does(capsys: pytest.CaptureFixture[str], here: Path, weights: str) -> None:
    options = ("--weights", weights, "--device", "cpu", "--data", "folder:mine")
    code, _, shown = run(capsys, "eval", *options, "--max-memory", "1MB")
    assert code == 2
    assert "60 x 40 pixels needs about" in shown
    code, _, _ = run(capsys, "eval", *options, "--scale", 0.9, "--max-memory", "1GB", "--too-large", "tile")
    assert code == 0
    record = json.loads((here / "evaluation/evaluation.json").read_text())
    assert record["model"]["limits"] == {"scale": 0.9, "max_memory": "1GB", "too_large": "tile"}


def test_the_semi_global_matcher_goes_through_the_same_door(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    arguments = ("eval", "--data", "folder:mine", "--overwrite", "--search-range", 32)
    metrics = {}
    for name in ("sgbm", "sgbm_unfilled", "sgbm_5paths", "sgbm_5paths_unfilled"):
        code, said, _ = run(capsys, *arguments, "--model", name)
        assert code == 0
        record = json.loads((here / "evaluation/evaluation.json").read_text())
        assert record["model"]["paths"] == (5 if "5paths" in name else 8)
        assert record["model"]["fill"] == ("unfilled" not in name)
        assert record["model"]["search_range"] == 32
        metrics[name] = record["datasets"][0]["metrics"]
        assert ("predicted pixels are not finite" in said) == ("unfilled" in name)
    assert metrics["sgbm"]["bad_1"] < 20
    assert metrics["sgbm"]["invalid_predictions"] == 0


def test_a_function_of_ones_own_goes_through_the_same_door(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    (here / "my_matcher.py").write_text("def five(left, right):\n    return left[:, :, 0] * 0.0 + 5\n")
    code, said, _ = run(capsys, "eval", "--model", "my_matcher:five", "--data", "folder:mine", "--limit", 1)
    assert code == 0
    assert " 1 image\n" in said
    record = json.loads((here / "evaluation/evaluation.json").read_text())
    assert record["model"] == {"matcher": "callable", "name": "my_matcher.five"}
    assert record["datasets"][0]["metrics"]["epe"] == 0
    assert "has no function 'six'" in fails(
        capsys, "eval", "--model", "my_matcher:six", "--data", "folder:mine", "--out", "o"
    )
    assert "can't be imported" in fails(
        capsys, "eval", "--model", "nothing_here:f", "--data", "folder:mine", "--out", "o"
    )


def test_the_weights_that_a_network_stands_for_are_recorded(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    assert run(capsys, "eval", "--weights", "coex", "--data", "folder:mine", "--limit", 1)[0] == 0
    record = json.loads((here / "evaluation/evaluation.json").read_text())
    assert record["model"]["weights"] == "coex.synthetic_v7"


def test_report_and_submission(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    data = ("--data", "kitti2015/testing:kitti15")
    code, said, _ = run(capsys, "eval", "--model", "sgbm", *data, "--report", "page", "--submission", "send")
    assert code == 0
    assert "1 of 1 pairs have no ground truth" in said
    assert "no pixels" in said
    assert read_kitti_png(here / "send/disp_0/000004_10.png").shape == SIZE
    assert "000004_10" in (here / "page/index.html").read_text()


@pytest.mark.parametrize("taken", ["evaluation/pairs.csv", "page/index.html", "send/000001_10.png"])
def test_nothing_is_overwritten_or_half_done(capsys: pytest.CaptureFixture[str], here: Path, taken: str) -> None:
    (here / taken).parent.mkdir()
    (here / taken).write_text("precious")
    files = {path for path in here.rglob("*") if path.is_file()}
    arguments = ("--model", "sgbm", "--data", "kitti2012:kitti", "--report", "page", "--submission", "send")
    assert "exists already" in fails(capsys, "eval", *arguments)
    assert {path for path in here.rglob("*") if path.is_file()} == files
    assert (here / taken).read_text() == "precious"
    assert run(capsys, "eval", *arguments, "--overwrite")[0] == 0
    assert (here / taken).read_bytes() != b"precious"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--model", "sgbmm"), "did you mean 'sgbm'"),
        (("--model", "psmnet"), "no weights for 'psmnet'"),
        (("--model", "sgbm", "--weights", "x"), "takes no --weights"),
        (("--model", "sgbm", "--channel-order", "rgb"), "takes no --channel-order"),
        (("--model", "sgbm", "--too-large", "tile"), "takes no --too-large"),
        (("--model", "sgbm", "--scale", "0.5"), "takes no --scale"),
        (("--model", "sgbm", "--device", "cuda"), "leave out --device"),
        (("--model", "sgbm", "--batch", "2"), "one pair at a time"),
        (("--model", "sgbm", "--limit", "0"), "limit is 0"),
        (("--model", "sgbm", "--search-range", "0"), "search_range is 0"),
        (("--model", "coex", "--search-range", "9"), "takes no --search-range"),
        (("--model", "sgbm", "--max-disparity", "-1"), "max_disparity is -1"),
        (("--model", "sgbm", "--data", "folder:mine"), "expected each once"),
        (("--model", "sgbm", "--data", "folder:nowhere"), "found nothing, it does not exist"),
        (("--model", "sgbm", "--data", "mine"), "expected KIND:ROOT"),
        (("--model", "sgbm", "--data", "kitti2015/testing:kitti15"), "has no ground truth, split 'testing'"),
        (("--model", "sgbm", "--submission", "s"), "is for kitti2012 or kitti2015, got folder"),
        (("--model", "sgbm", "--data", "kitti2012:kitti", "--submission", "s"), "takes one data set"),
        (("--model", "sgbm", "--report", "mine/a/left.png/below"), "mine/a/left.png' is a file; choose another"),
    ],
)
def test_bad_input_is_one_line(
    capsys: pytest.CaptureFixture[str], here: Path, arguments: tuple[str, ...], message: str
) -> None:
    assert message in fails(capsys, "eval", "--data", "folder:mine", *arguments)
    assert not (here / "evaluation").exists()


def test_broken_pairs_are_errors(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    def message() -> str:
        code, out, err = run(capsys, "eval", "--model", "sgbm", "--data", "folder:mine")
        assert (code, out) == (2, "")
        assert not (here / "evaluation").exists()
        return err.splitlines()[-1]

    write_disparity("mine/b/disparity.pfm", np.ones((SIZE[0] - 1, SIZE[1])), overwrite=True)
    assert "'b': the ground truth is 60 x 39 pixels, the left image 60 x 40" in message()
    Path("mine/b/right.png").unlink()
    assert "1 of its files are missing, the first is 'b/right.png'" in message()


@needs_shared
def test_the_pilot_on_kitti(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    root = SHARED / "data/real/kitti2012"
    pilot = ("--weights", SHARED / "golden/coex_pilot.ckpt", "--channel-order", "rgb")
    code, _, _ = run(capsys, "eval", *pilot, "--data", f"kitti2012:{root}", "--limit", 1, "--out", tmp_path)
    assert code == 0
    [result] = json.loads((tmp_path / "evaluation.json").read_text())["datasets"]
    assert result["pairs"][0]["metrics"]["bad_3"] == pytest.approx(5.6, abs=0.1)
