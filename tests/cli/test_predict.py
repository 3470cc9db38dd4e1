import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from torch import Tensor

from stereokit.backends.eager import TorchBackend
from stereokit.backends.estimate import Estimate
from stereokit.data import read_disparity, write_image
from stereokit.data.images import write_samples
from tests.cli.commands import fails, run


def test_predict_writes_all_formats_and_says_so(capsys: pytest.CaptureFixture[str], images: Path, weights: str) -> None:
    out = images / "out"
    code, said, _ = run(
        capsys, "predict", images / "left/a.png", images / "right/a.png", "--weights", weights, "--out", out
    )
    assert code == 0
    assert sorted(path.name for path in out.iterdir()) == sorted(
        ["a_disparity.png", "a_disparity.pfm", "a_disparity.npz", "a_picture.png"]
    )
    disparity = read_disparity(out / "a_disparity.pfm")
    assert disparity.shape == (40, 50)
    assert f"disparity {disparity.min():.1f} to {disparity.max():.1f} px" in said
    assert "50 x 40 px" in said
    assert " s on " in said
    assert all(str(path) in said for path in out.iterdir())


@pytest.mark.parametrize(("left", "right"), [("left", "right"), ("left/*.png", "right/*.png")])
def test_predict_takes_folders_and_patterns(
    capsys: pytest.CaptureFixture[str], images: Path, weights: str, left: str, right: str
) -> None:
    code, said, shown = run(
        capsys, "predict", images / left, images / right, "--weights", weights, "--out", images / "out"
    )
    assert code == 0
    assert len(list((images / "out").iterdir())) == 8 + 1
    assert "a: 50 x 40" in said
    assert "b: 50 x 40" in said
    assert "2/2" in shown


def test_predict_goes_on_after_a_broken_pair(capsys: pytest.CaptureFixture[str], images: Path, weights: str) -> None:
    (images / "left/a.png").write_text("broken")
    code, said, err = run(
        capsys, "predict", images / "left", images / "right", "--weights", weights, "--out", images / "out"
    )
    assert code == 2
    assert "b: 50 x 40" in said
    assert "1 of 2 pairs could not be matched: a" in err
    assert len(list((images / "out").iterdir())) == 4 + 1


def test_predict_says_which_networks_have_weights(capsys: pytest.CaptureFixture[str], images: Path) -> None:
    pair = images / "left/a.png", images / "right/a.png"
    said = fails(capsys, "predict", *pair, "--model", "psmnet", "--out", images / "out")
    assert "no weights for 'psmnet'; there are coex.synthetic_v7" in said
    assert "use (--weights) a saved network" in said
    said = fails(capsys, "predict", *pair, "--model", "psmnet", "--weights", "coex.synthetic_v7")
    assert "holds a coex, not a psmnet" in said
    said = fails(capsys, "predict", *pair, "--top-k", "3", "--out", images / "out")
    assert "can only be given for published checkpoints" in said
    assert not (images / "out").exists()


def test_predict_without_weights_takes_those_of_the_library(capsys: pytest.CaptureFixture[str], images: Path) -> None:
    code, said, _ = run(capsys, "predict", images / "left/a.png", images / "right/a.png", "--out", images / "out")
    assert code == 0
    assert "50 x 40 px" in said


@pytest.mark.slow
def test_the_name_of_a_network_stands_for_its_weights(
    capsys: pytest.CaptureFixture[str], images: Path, weights: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(images)
    pair = "left/a.png", "right/a.png"
    assert run(capsys, "predict", *pair, "--out", "default")[0] == 0
    assert run(capsys, "predict", *pair, "--out", "named", "--weights", "coex")[0] == 0
    assert Path("named/a_disparity.pfm").read_bytes() == Path("default/a_disparity.pfm").read_bytes()
    # a folder of that name goes first
    shutil.copytree(weights, "coex")
    assert run(capsys, "predict", *pair, "--out", "folder", "--weights", "coex")[0] == 0
    assert Path("folder/a_disparity.pfm").read_bytes() != Path("default/a_disparity.pfm").read_bytes()
    # but not where no place was given
    assert run(capsys, "predict", *pair, "--out", "model", "--model", "coex")[0] == 0
    assert Path("model/a_disparity.pfm").read_bytes() == Path("default/a_disparity.pfm").read_bytes()


def test_predict_keeps_existing_files(capsys: pytest.CaptureFixture[str], images: Path, weights: str) -> None:
    arguments = ("predict", images / "left/a.png", images / "right/a.png", "--weights", weights, "--out", images / "o")
    assert run(capsys, *arguments)[0] == 0
    assert "--overwrite" in fails(capsys, *arguments)
    assert run(capsys, *arguments, "--overwrite")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("left/none.png", "right/a.png"), "none.png' does not exist"),
        (("left", "right/a.png"), "is a folder and"),
        (("left/a.png", "right/small.png"), "one size"),
        (("left/text.png", "right/a.png"), "no image"),
        (("left/a.png", "right/a.png", "--model", "coexx"), "did you mean 'coex'"),
        (("left/a.png", "right/a.png", "--device", "tpu"), "use 'auto' or 'cpu'"),
        (("left/a.png", "right/a.png", "--model", "psmnet", "--weights", "SAVED"), "holds a coex, not a psmnet"),
        (("left/a.png", "right/a.png", "--weights", "nowhere"), "unknown network 'nowhere', and no file or folder"),
        (("left/a.png", "right/a.png", "--weights", "coex.synthetic_v1"), "did you mean 'coex.synthetic_v7'"),
        (("left/a.png", "right/a.png", "--weights", "psmnet"), "no weights for 'psmnet'; there are coex.synthetic_v7"),
        (("left/a.png", "right/a.png", "--weights", "left/program.pt2"), "which torch.export.load reads"),
        (
            ("left/a.png", "right/a.png", "--top-k", "3", "--weights", "SAVED"),
            "top_k (--top-k) can only be given for published",
        ),
        (("left/a.png", "right/a.png", "--weights", "left/a.png"), "a.png"),
        (("left/a.png", "left/b.png", "right/a.png"), "in quotes"),
        (("left/a.png",), "right"),
        (("left/a.png", "right/a.png", "--out", "left/b.png"), "the folder 'left/b.png': it is a file"),
        (("left/a.png", "right/a.png", "--out", "left/b.png/below/it"), "left/b.png' is a file; choose another folder"),
    ],
)
def test_bad_input_is_one_line(
    capsys: pytest.CaptureFixture[str],
    images: Path,
    weights: str,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.chdir(images)
    write_image("right/small.png", np.zeros((33, 50, 3), np.uint8))
    Path("left/text.png").write_text("no image at all")
    Path("left/program.pt2").touch()
    given = [weights if a == "SAVED" else a for a in arguments]
    if "--weights" not in given and "--model" not in given:
        given += ["--weights", weights]
    assert message in fails(capsys, "predict", *given)
    assert not Path("disparity").exists()


def test_the_folder_for_results_is_looked_at_before_the_network_is_loaded(
    capsys: pytest.CaptureFixture[str], images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pair = images / "left/a.png", images / "right/a.png"
    absent = ("--weights", images / "absent")
    assert "it is a file" in fails(capsys, "predict", *pair, *absent, "--out", images / "left/a.png")
    (images / "link").symlink_to("away")
    assert "it is no folder" in fails(capsys, "predict", *pair, *absent, "--out", images / "link")
    # the tests may run as root, who may write anywhere
    monkeypatch.setattr("os.access", lambda place, mode: False)
    assert f"'{images}' may not be written to" in fails(capsys, "predict", *pair, *absent, "--out", images / "out")


def test_failing_pairs_leave_no_files_but_the_manifest(
    capsys: pytest.CaptureFixture[str], images: Path, weights: str
) -> None:
    for side in ("left", "right"):
        for name in ("a", "b"):
            (images / side / f"{name}.png").write_text("broken")
    more = ("--weights", weights, "--out", images / "out")
    assert run(capsys, "predict", images / "left/a.png", images / "right/a.png", *more)[0] == 2
    assert not (images / "out").exists()
    assert run(capsys, "predict", images / "left", images / "right", *more)[0] == 2
    assert [path.name for path in (images / "out").iterdir()] == ["manifest.jsonl"]


def test_a_second_run_says_what_is_done(capsys: pytest.CaptureFixture[str], images: Path, weights: str) -> None:
    given = ("predict", images / "left", images / "right", "--weights", weights, "--out", images / "out")
    assert "2 pairs matched in" in run(capsys, *given, "--workers", "0")[1]
    (images / "out/b_picture.png").write_text("damaged")
    _, said, _ = run(capsys, *given)
    assert "b: matched again: b_picture.png is missing or damaged" in said
    assert "a: " not in said
    assert said.splitlines()[-1].startswith("1 pair matched in")
    assert said.splitlines()[-1].endswith(f", 1 pair done before; {images / 'out/manifest.jsonl'} tells of each")
    said = fails(capsys, *given, "--scale", "1.5")
    assert "2 results in" in said
    assert "made with other settings" in said
    code, _, err = run(capsys, *given, "--scale", "1.5", "--overwrite")
    assert code == 0
    assert "2/2" in err


def test_options_for_many_pairs_are_refused_for_one(
    capsys: pytest.CaptureFixture[str], images: Path, weights: str
) -> None:
    pair = images / "left/a.png", images / "right/a.png"
    for option in ("--workers", "--processes"):
        said = fails(capsys, "predict", *pair, "--weights", weights, option, "2")
        assert f"{option} has no effect on one pair of files" in said


def test_predict_says_what_is_not_finite(
    capsys: pytest.CaptureFixture[str], images: Path, monkeypatch: pytest.MonkeyPatch, weights: str
) -> None:
    real = TorchBackend.__call__

    def broken(columns: int) -> Callable[..., Estimate]:
        def call(self: TorchBackend, left: Tensor, right: Tensor) -> Estimate:
            estimate = real(self, left, right)
            estimate.disparity[..., :columns] = np.nan
            return estimate

        return call

    arguments = ("predict", images / "left/a.png", images / "right/a.png", "--weights", weights, "--out", images / "o")
    monkeypatch.setattr(TorchBackend, "__call__", broken(10))
    code, _, err = run(capsys, *arguments)
    assert code == 0
    assert "a: 400 pixels (20.0 %) have no finite disparity, in float32 on" in err
    monkeypatch.setattr(TorchBackend, "__call__", broken(50))
    assert "no finite disparity at any pixel" in fails(capsys, *arguments, "--overwrite")


def test_predict_in_images_of_fewer_bits_and_from_another_disparity_on(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, weights: str
) -> None:
    deep = np.random.default_rng(0).integers(0, 4096, (40, 90, 3)).astype(np.uint16)
    for name, samples in (("dark", deep), ("full", np.rint(deep * (65535 / 4095)).astype(np.uint16))):
        write_samples(tmp_path / f"{name}_left.png", samples, overwrite=False)
        write_samples(tmp_path / f"{name}_right.png", np.roll(samples, 5, 1), overwrite=False)
    (tmp_path / "calib.txt").write_text("P0: 70 0 45 0 0 70 20 0 0 0 1 0\nP1: 70 0 45 -35 0 70 20 0 0 0 1 0\n")
    found = {}
    for name, more in (("dark", ("--bit-depth", 12)), ("full", ())):
        pair = [tmp_path / f"{name}_{view}.png" for view in ("left", "right")]
        options = ("--weights", weights, "--device", "cpu", "--out", tmp_path / "out", "--min-disparity", -16, *more)
        metres = ("--calibration", tmp_path / "calib.txt", "--depth", "--cloud", "ply", "--left-right")
        code, said, _ = run(capsys, "predict", *pair, *options, *metres)
        assert code == 0
        found[name] = read_disparity(tmp_path / f"out/{name}_left_disparity.pfm")
        assert found[name].min() >= -16
        assert ("no 16-bit PNG" in said) == bool(found[name].min() < 0)
    np.testing.assert_allclose(found["dark"], found["full"], atol=1e-2)
    for name in ("left", "right"):
        (tmp_path / name).mkdir()
        shutil.copy(tmp_path / f"dark_{name}.png", tmp_path / name / "dark.png")
    options = ("--weights", weights, "--device", "cpu", "--min-disparity", -16, "--bit-depth", 12)
    metres = ("--calibration", tmp_path / "calib.txt", "--depth", "--left-right")
    given = ("predict", tmp_path / "left", tmp_path / "right", *options, *metres, "--out", tmp_path / "many")
    assert run(capsys, *given)[0] == 0
    np.testing.assert_array_equal(
        read_disparity(tmp_path / "many/dark_disparity.pfm"), read_disparity(tmp_path / "out/dark_left_disparity.pfm")
    )
    assert "1 pair done before" in run(capsys, *given)[1]
    assert "min_disparity -16, not None" in fails(capsys, *(v for v in given if v not in ("--min-disparity", -16)))
    with_8 = (tmp_path / "out/dark_left_picture.png",) * 2
    assert "8 bits per sample" in fails(
        capsys, "predict", *with_8, "--weights", weights, "--bit-depth", 12, "--out", tmp_path / "o"
    )
