import json

import pytest
import torch

from stereokit import build_model
from stereokit.cli import main
from stereokit.data import read_disparity, write_image

pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")
pytest.importorskip("openvino")


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("weights")
    build_model("coex", max_disparity=32, backbone={"name": "spatial_pyramid"}, upsampler="bilinear").save_pretrained(
        folder
    )
    return str(folder)


@pytest.fixture(scope="module")
def exported(weights, tmp_path_factory):
    path = tmp_path_factory.mktemp("exported") / "model.onnx"
    assert main(["export", weights, "--to", "onnx", "--out", str(path), "--size", "40", "64"]) == 0
    return path


@pytest.fixture
def images(tmp_path):
    for i, name in enumerate(("left", "right")):
        generator = torch.Generator().manual_seed(i)
        image = torch.randint(256, (40, 64, 3), generator=generator, dtype=torch.uint8)
        write_image(tmp_path / f"{name}.png", image.numpy())
    return [str(tmp_path / "left.png"), str(tmp_path / "right.png")]


def fails(capsys, *arguments):
    """The one line that a failing command prints."""
    capsys.readouterr()
    assert main([str(a) for a in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    return captured.err


@pytest.mark.slow
def test_predict_gives_the_same_through_the_file(weights, exported, images, tmp_path, capsys):
    maps = []
    for i, place in enumerate((weights, exported)):
        out = tmp_path / str(i)
        assert main(["predict", *images, "--weights", str(place), "--out", str(out), "--device", "cpu"]) == 0
        maps.append(read_disparity(out / "left_disparity.pfm"))
    assert "disparity" in capsys.readouterr().out
    assert abs(maps[0] - maps[1]).mean() < 1e-3


def test_eval_takes_the_file_and_records_it(exported, tmp_path):
    scenes = tmp_path / "scenes"
    main(["synth", "--count", "2", "--out", str(scenes), "--size", "40", "64", "--max-disparity", "16"])
    arguments = [
        "eval",
        "--weights",
        exported,
        "--data",
        f"sceneflow:{scenes}",
        "--out",
        tmp_path / "out",
        "--batch",
        2,
    ]
    assert main([str(a) for a in arguments]) == 0
    record = json.loads((tmp_path / "out/evaluation.json").read_text())["model"]
    assert record["backend"] == "onnxruntime"
    assert record["export"]["size"] == [40, 64]
    assert record["configuration"]["name"] == "coex"
    assert len(record["weights_file_sha256"]) == 64


def test_bad_requests_are_one_line(weights, exported, images, tmp_path, capsys):
    out = tmp_path / "a.xml"
    openvino = ("export", weights, "--to", "openvino", "--out", out)
    assert "--calibrate synthetic" in fails(capsys, *openvino, "--precision", "int8")
    assert "--opset is for --to onnx" in fails(capsys, *openvino, "--opset", 18)
    assert "for --to openvino" in fails(capsys, *openvino[:3], "onnx", "--out", "a.onnx", "--precision", "int8")
    assert "does not end in .onnx" in fails(capsys, *openvino[:3], "onnx", "--out", out)
    assert "exists already" in fails(capsys, *openvino[:3], "onnx", "--out", exported)
    assert "is an exported file" in fails(capsys, "export", exported, *openvino[2:])
    predict = ("predict", *images, "--out", tmp_path / "out", "--weights")
    assert "leave out network (--model)" in fails(capsys, *predict, exported, "--model", "coex")
    assert "stereokit export --to onnx" in fails(capsys, *predict, weights, "--backend", "onnxruntime")
    assert "unknown backend" in fails(capsys, *predict, weights, "--backend", "fast")
    assert not out.exists()


@pytest.mark.slow
def test_int8_is_calibrated_on_rendered_pairs(weights, tmp_path, capsys):
    pytest.importorskip("nncf")
    out = tmp_path / "a.xml"
    arguments = ["export", weights, "--to", "openvino", "--out", out, "--size", 64, 96, "--precision", "int8"]
    arguments += ["--calibrate", "synthetic", "--calibration-pairs", 4]
    assert main([str(a) for a in arguments]) == 0
    said = capsys.readouterr().out
    # rendered scenes 0 to 3 calibrate, the four that follow tell
    assert all(f"rendered scene {i}, 96 x 64 px" in said for i in range(4, 8))
    assert "rendered scene 3" not in said
