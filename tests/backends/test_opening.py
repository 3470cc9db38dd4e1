import sys

import pytest
import torch
from torch import nn

from stereokit import CheckpointError, ConfigError, Predictor, StereoOutput
from stereokit.backends import BACKENDS, open_backend
from stereokit.weights.places import is_exported


class Flat(nn.Module):
    def forward(self, left, right):
        return StereoOutput(left.float().mean(1))


@pytest.mark.parametrize(("suffix", "extra"), [("onnx", "onnx"), ("xml", "openvino")])
def test_a_backend_that_is_not_installed_names_its_extra(suffix, extra, tmp_path, monkeypatch):
    package = {"onnx": "onnxruntime", "xml": "openvino"}[suffix]
    # an import of None fails
    monkeypatch.setitem(sys.modules, package, None)
    path = tmp_path / f"a.{suffix}"
    path.touch()
    with pytest.raises(ConfigError, match=rf"needs the package {package}.* pip install 'stereokit\[{extra}\]'"):
        Predictor(path)


def test_unknown_and_unfitting_backends_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="unknown backend 'onnx'; did you mean 'onnxruntime'"):
        Predictor(Flat(), "cpu", "onnx")
    with pytest.raises(ConfigError, match="write one first, with stereokit export --to openvino"):
        Predictor(Flat(), "cpu", "openvino")
    (tmp_path / "a.onnx").touch()
    for backend in ("torch", "compile", "openvino"):
        with pytest.raises(ConfigError, match=f"is run by backend 'onnxruntime', not '{backend}'"):
            Predictor(tmp_path / "a.onnx", backend=backend)
    with pytest.raises(CheckpointError, match="does not exist"):
        Predictor(tmp_path / "b.onnx")


@pytest.mark.parametrize("suffix", ["onnx", "xml"])
def test_damaged_files_are_refused(suffix, tmp_path):
    pytest.importorskip({"onnx": "onnxruntime", "xml": "openvino"}[suffix])
    path = tmp_path / f"a.{suffix}"
    for content in (b"", b"nonsense", b"<net/>"):
        path.write_bytes(content)
        with pytest.raises(CheckpointError) as error:
            Predictor(path)
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("suffix", ["onnx", "xml"])
def test_absent_devices_are_refused(suffix, tmp_path):
    pytest.importorskip({"onnx": "onnxruntime", "xml": "openvino"}[suffix])
    path = tmp_path / f"a.{suffix}"
    path.touch()
    with pytest.raises(ConfigError, match="can't use device 'mps' here; use 'auto' or 'cpu'"):
        Predictor(path, "mps")
    for device in ("tpu9", None):
        with pytest.raises(ConfigError, match=f"can't use device '{device}' here"):
            Predictor(path, device)


def test_the_names_are_those_that_the_command_line_offers():
    assert BACKENDS == ("torch", "compile", "onnxruntime", "openvino")
    assert open_backend(Flat(), torch.device("cpu"), "compile").name == "compile"
    assert is_exported("a.ONNX")
    assert not is_exported(Flat())
