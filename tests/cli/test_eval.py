import csv
import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from stereokit.data import read_kitti_png, write_disparity, write_image
from stereokit.data.images import write_samples
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


@pytest.mark.slow
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
        # the pair before the broken one was counted
        [left] = (here / "evaluation").iterdir()
        assert left.name == "pairs.part.jsonl"
        assert [json.loads(line)["name"] for line in left.read_text().splitlines()] == ["a"]
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


def save_toed_in(folder: Path, disparity: int) -> None:
    """A pair at one disparity below 0, and its truth."""
    scene = np.random.default_rng(0).integers(0, 256, (40, 140, 3), dtype=np.uint8)
    folder.mkdir()
    write_image(folder / "left.png", scene[:, 20:120])
    write_image(folder / "right.png", scene[:, 20 + disparity : 120 + disparity])
    write_disparity(folder / "disparity.pfm", np.full((40, 100), disparity, np.float32))


def test_disparities_below_0(capsys: pytest.CaptureFixture[str], here: Path, weights: str) -> None:
    save_toed_in(here / "toed", -10)
    arguments = ("eval", "--data", "folder:toed", "--overwrite", "--report", "page")
    code, said, _ = run(capsys, *arguments, "--model", "sgbm")
    assert code == 0
    assert "no pixels" in said
    assert "of the ground truth's 4,000 values 0 count: 100.0 % below 0 do not" in said
    code, said, _ = run(capsys, *arguments, "--model", "sgbm", "--min-disparity", -16, "--search-range", 16)
    assert code == 0
    record = json.loads((here / "evaluation/evaluation.json").read_text())
    assert record["settings"]["min_disparity"] == record["model"]["min_disparity"] == -16
    assert record["datasets"][0]["metrics"]["pixels"] == 4000
    assert record["datasets"][0]["metrics"]["bad_1"] < 5
    assert "at least -16 px" in record["masks"]["counted"]
    assert "Ground truth" in (here / "page/index.html").read_text()
    code, said, _ = run(capsys, *arguments, "--weights", weights, "--device", "cpu", "--min-disparity", -16)
    assert code == 0
    assert "4,000 pixels" in said
    assert run(capsys, *arguments, "--weights", weights, "--min-disparity", -100)[0] == 2


def test_the_depth_of_the_cameras_is_said_once_for_all(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    dark = (np.random.default_rng(0).integers(0, 4096, (40, 60, 3))).astype(np.uint16)
    (here / "dark").mkdir()
    for view in ("left", "right"):
        write_samples(here / f"dark/{view}.png", dark, overwrite=False)
    write_disparity(here / "dark/disparity.pfm", np.ones((40, 60), np.float32))
    (here / "brightness.py").write_text("def of(left, right):\n    return left[:, :, 0] * 1000\n")
    arguments = ("eval", "--model", "brightness:of", "--overwrite")
    with pytest.warns(UserWarning, match="need 12 bits only"):
        assert run(capsys, *arguments, "--data", "folder:dark")[0] == 0
    without = json.loads((here / "evaluation/evaluation.json").read_text())["datasets"][0]["metrics"]["epe"]
    for words in (("--data", "folder:dark", "--bit-depth", 12), ("--data", "folder,bit_depth=12:dark")):
        assert run(capsys, *arguments, *words)[0] == 0
        bright = json.loads((here / "evaluation/evaluation.json").read_text())["datasets"][0]["metrics"]["epe"]
        assert bright == pytest.approx(16 * without, rel=0.05)
    assert "leave out bit_depth=12" in run(capsys, *arguments, "--data", "folder:mine", "--bit-depth", 12)[2]
    assert "bit_depth must be" in fails(capsys, *arguments, "--data", "folder:mine", "--bit-depth", 17)
    assert "bit_depth must be" in fails(capsys, *arguments, "--data", "folder,bit_depth=x:mine")


@pytest.mark.parametrize(
    ("gives", "hint"),
    [
        ("(left[:, :, 0] * 0).astype('int16') - 16 + 32 * (left[:, :, 0] > 9)", "divide by 16.0"),
        ("-1.5 - left[:, :, 0] / 9", "all disparities are negative"),
        ("left[:, :, 0] // 16 * 16.0", "multiples of 16"),
        ("left[:, :, 0]", "whole numbers (uint8)"),
    ],
)
def test_predictions_of_another_unit_are_doubted(
    capsys: pytest.CaptureFixture[str], here: Path, gives: str, hint: str
) -> None:
    (here / "odd_unit.py").write_text(f"def of(left, right):\n    return {gives}\n")
    sys.modules.pop("odd_unit", None)
    code, said, _ = run(capsys, "eval", "--data", "folder:mine", "--model", "odd_unit:of")
    assert code == 0
    [line] = [line for line in said.splitlines() if "predictions of" in line]
    assert "predictions of 2 pairs: " in line
    assert hint in line


def test_odd_names_are_results_as_any_others(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = [os.fsdecode(b"no\xffutf8"), "=1+1", "new\nline", "-\x1b[31mred"]
    try:
        for number, name in enumerate(names):
            save_scene(tmp_path / "odd", name, 5, seed=number)
    except OSError:
        pytest.skip("this file system takes no such names")
    code, _, err = run(capsys, "eval", "--model", "sgbm", "--data", "folder:odd", "--report", "page")
    assert (code, "Traceback" in err) == (0, False)
    text = (tmp_path / "evaluation/pairs.csv").read_text(encoding="utf-8")
    rows = [row["pair"] for row in csv.DictReader(text.splitlines())]
    assert sorted(rows) == sorted(["no\\udcffutf8", "'=1+1", "new\\nline", "'-\\x1b[31mred"])
    record = json.loads((tmp_path / "evaluation/evaluation.json").read_text())
    assert {pair["name"] for pair in record["datasets"][0]["pairs"]} == set(names)
    assert "no\\udcffutf8" in (tmp_path / "page/index.html").read_text(encoding="utf-8")
    assert not list(tmp_path.glob("evaluation/*.part*"))


def test_what_was_found_before_the_end_is_kept(capsys: pytest.CaptureFixture[str], here: Path) -> None:
    (here / "stops.py").write_text(
        "calls = []\n"
        "def of(left, right):\n"
        "    calls.append(1)\n"
        "    if len(calls) > 2:\n"
        "        raise KeyboardInterrupt\n"
        "    return left[:, :, 0] / 9\n"
    )
    arguments = ("eval", "--data", "folder:mine", "--model", "stops:of")
    assert run(capsys, *arguments)[0] == 130
    [line] = (here / "evaluation/pairs.part.jsonl").read_text().splitlines()
    assert json.loads(line)["name"] == "a"
    assert json.loads(line)["metrics"]["pixels"] > 0
    (here / "fine.py").write_text("def of(left, right):\n    return left[:, :, 0] / 9\n")
    # what is refused before the first pair leaves it there, and what is matched replaces it
    assert run(capsys, "eval", "--data", "folder:nowhere", "--model", "fine:of")[0] == 2
    assert (here / "evaluation/pairs.part.jsonl").exists()
    code, _, shown = run(capsys, "eval", "--data", "folder:mine", "--model", "fine:of")
    assert code == 0
    assert "replacing 'evaluation/pairs.part.jsonl', which an evaluation left that did not end" in shown
    assert sorted(p.name for p in (here / "evaluation").iterdir()) == ["datasets.csv", "evaluation.json", "pairs.csv"]
