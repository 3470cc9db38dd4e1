import dataclasses
import os
from collections import Counter

import numpy as np
import pytest
import torch
from torch import nn

from stereokit import CheckpointError, ConfigError, InputError, Predictor, StereoOutput, build_model
from stereokit._version import __version__
from stereokit.backends.metadata import FORMAT, KEY, ExportMetadata
from stereokit.export import export_onnx
from stereokit.export.checking import random_pair
from stereokit.models.ablation import ABLATION
from stereokit.runtime.memory import estimate_memory
from tests.export.networks import Untrue
from tests.optimize.networks import settle

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")

CONTROL_FLOW = {"If", "Loop", "Scan", "SequenceMap"}
SORTS = {"NonZero", "Unique", "NonMaxSuppression", "Compress"}


@pytest.fixture(scope="module")
def exported(tiny, tmp_path_factory):
    path = tmp_path_factory.mktemp("onnx") / "tiny.onnx"
    return export_onnx(tiny, path)


def check_ready_for_tensorrt(path):
    """Standard operators, no control flow, nothing of a size that hangs on the data, a constant k."""
    model = onnx.load(path)
    onnx.checker.check_model(model)
    assert {entry.domain for entry in model.opset_import} == {""}
    assert not model.functions
    kinds = Counter(node.op_type for node in model.graph.node)
    assert {node.domain for node in model.graph.node} == {""}
    assert kinds.keys().isdisjoint(CONTROL_FLOW | SORTS)
    constants = {value.name for value in model.graph.initializer}
    constants |= {node.output[0] for node in model.graph.node if node.op_type == "Constant"}
    assert all(node.input[1] in constants for node in model.graph.node if node.op_type == "TopK")
    return kinds


def test_the_file_says_what_it_holds(exported, tiny):
    model = onnx.load(exported.path)
    properties = {entry.key: entry.value for entry in model.metadata_props}
    metadata = ExportMetadata.read(properties, "tiny.onnx")
    assert metadata == exported.metadata
    assert metadata == ExportMetadata(None, 16, None, "float32", 18, __version__, FORMAT)
    assert [entry.version for entry in model.opset_import] == [18]
    shapes = {
        value.name: [dim.dim_param or dim.dim_value for dim in value.type.tensor_type.shape.dim]
        for value in (*model.graph.input, *model.graph.output)
    }
    assert shapes == {
        "left": [1, 3, "height", "width"],
        "right": [1, 3, "height", "width"],
        "disparity": [1, "height", "width"],
        "confidence": [1, "height", "width"],
    }
    assert os.sep + "stereokit" not in exported.path.read_bytes().decode("latin-1"), "a path of this machine"


def test_it_is_ready_for_tensorrt(exported):
    check_ready_for_tensorrt(exported.path)


def test_the_report_says_how_far_it_is_off(exported):
    sizes = [difference.size for difference in exported.differences]
    assert any(h % 8 == 0 and w % 8 == 0 for h, w in sizes)
    assert any(h % 8 and w % 8 for h, w in sizes)
    assert all(difference.highest < 1e-3 for difference in exported.differences)
    assert "opset 18" in str(exported)


@pytest.mark.parametrize("size", [(32, 32), (33, 47), (64, 96), (101, 77)])
@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_the_predictor_runs_it_as_it_runs_the_network(exported, tiny, size, kind):
    images = np.random.default_rng(0).random((2, *size, 3), dtype=np.float32)
    left, right = images if kind == np.float32 else (255 * images).astype(np.uint8)
    given, expected = Predictor(exported.path)(left, right), Predictor(tiny, "cpu")(left, right)
    np.testing.assert_allclose(given.disparity, expected.disparity, atol=1e-4)
    np.testing.assert_allclose(given.confidence, expected.confidence, atol=1e-5)


def test_a_fixed_size_takes_no_other(tiny, tmp_path):
    report = export_onnx(tiny, tmp_path / "fixed.onnx", size=(40, 64), opset=20)
    assert (report.metadata.size, report.metadata.opset) == ((40, 64), 20)
    predict = Predictor(tmp_path / "fixed.onnx")
    assert predict(*random_pair(40, 64)).size == (40, 64)
    with pytest.raises(InputError, match=r"are 50 x 60 pixels, but .* exported for 64 x 40 alone"):
        predict(*random_pair(60, 50))


def saying(path, text, folder):
    """A copy of a file that says something else of itself."""
    model = onnx.load(path)
    [entry] = [entry for entry in model.metadata_props if entry.key == KEY]
    entry.value = text
    onnx.save(model, folder / "other.onnx")
    return folder / "other.onnx"


@pytest.mark.slow
def test_pairs_are_held_to_limits_of_memory(exported, tmp_path):
    config = dict(build_model("coex", max_disparity=32).config)
    path = saying(exported.path, dataclasses.replace(exported.metadata, network=config).to_json(), tmp_path)
    left, right = random_pair(320, 700)
    whole = Predictor(path, max_memory="100GB")(left, right)
    network = build_model(config).eval()
    allowed = int(0.5 * estimate_memory(network, 320, 700))
    with pytest.raises(
        InputError, match=r"a pair of 700 x 320 pixels needs about .* too_large='tile' \(--too-large tile\) would match"
    ):
        Predictor(path, max_memory=allowed)(left, right)
    tiled = Predictor(path, max_memory=allowed, too_large="tile")(left, right)
    # the network in the file looks no farther than a few pixels
    np.testing.assert_allclose(tiled.disparity, whole.disparity, atol=1e-4)
    np.testing.assert_allclose(tiled.confidence, whole.confidence, atol=1e-5)
    reduced = Predictor(path, max_memory=allowed, too_large="reduce")(left, right)
    assert reduced.size == (320, 700)
    assert not np.array_equal(reduced.disparity, whole.disparity)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({}, "does not name its components"),
        ({"network": {"name": "coex"}, "size": (320, 700)}, "was exported for one size alone"),
        ({"network": {"name": "unheard_of"}}, "unheard_of"),
    ],
)
def test_files_that_can_not_be_held_to_limits_say_so_and_run_without(exported, tmp_path, changed, message, monkeypatch):
    path = saying(exported.path, dataclasses.replace(exported.metadata, **changed).to_json(), tmp_path)
    for limits in ({"max_memory": "1GiB"}, {"too_large": "tile"}):
        with pytest.raises(ConfigError, match=message):
            Predictor(path, **limits)
    monkeypatch.setattr("stereokit.inference.planning.LARGE", 1000)
    assert Predictor(path)(*random_pair(320, 700)).size == (320, 700)


def test_running_out_of_memory_is_the_same_line_as_elsewhere(exported):
    predict = Predictor(exported.path)

    class Full:
        def run(self, *_):
            raise type("Fail", (Exception,), {})("[ONNXRuntimeError] : Failed to allocate memory for requested buffer")

    predict.backend._session = Full()
    with pytest.raises(InputError, match="96 x 64 pixels does not fit into the memory of cpu"):
        predict(*random_pair(64, 96))


def test_a_file_holds_no_module(exported):
    with pytest.raises(ConfigError, match="backend 'onnxruntime' runs an exported file, which holds no torch module"):
        _ = Predictor(exported.path).model


def test_a_network_without_confidence_has_one_output(tmp_path):
    class Bare(nn.Module):
        def forward(self, left, right):
            return StereoOutput((left - right).mean(1).abs())

    report = export_onnx(Bare(), tmp_path / "bare.onnx")
    assert Predictor(report.path)(*random_pair(40, 50)).confidence is None


def test_the_network_is_left_as_it_was(tiny, tmp_path):
    class Mode(nn.Module):
        def __init__(self):
            super().__init__()
            self.inner = nn.Dropout()

        def forward(self, left, right):
            return StereoOutput(self.inner(left).mean(1))

    model = Mode().train()
    model.inner.eval()
    export_onnx(model, tmp_path / "mode.onnx", size=(32, 32))
    assert model.training
    assert not model.inner.training


def test_bad_requests_are_refused_and_leave_nothing(tiny, tmp_path):
    (tmp_path / "taken.onnx").write_text("precious")
    for path, arguments, error, message in (
        ("a.xml", {}, InputError, "does not end in .onnx"),
        ("taken.onnx", {}, InputError, "exists already"),
        ("no/a.onnx", {}, InputError, "does not exist"),
        ("a.onnx", {"opset": 11}, ConfigError, "opset 11 can't be written; use 18 to 23"),
        ("a.onnx", {"size": (16, 64)}, InputError, "at least 32 x 32"),
    ):
        with pytest.raises(error, match=message):
            export_onnx(tiny, tmp_path / path, **arguments)
    with pytest.raises(ConfigError, match=r"takes a network; got str"):
        export_onnx("coex", tmp_path / "a.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["taken.onnx"]
    assert (tmp_path / "taken.onnx").read_text() == "precious"


def test_a_file_that_is_wrong_is_not_kept(tmp_path):
    (tmp_path / "old.onnx").write_text("precious")
    with pytest.raises(ConfigError, match=r"wrong and was not kept: random texture, .* at 100 %"):
        export_onnx(Untrue(), tmp_path / "old.onnx", overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["old.onnx"]
    assert (tmp_path / "old.onnx").read_text() == "precious"


def test_an_operator_without_a_counterpart_names_its_block(tmp_path):
    class Bessel(nn.Module):
        def forward(self, x):
            return torch.special.bessel_j0(x)

    class Network(nn.Module):
        def __init__(self):
            super().__init__()
            self.head = nn.Sequential(nn.Identity(), Bessel())

        def forward(self, left, right):
            return StereoOutput(self.head(left - right).mean(1))

    with pytest.raises(ConfigError, match=r"the block head\.1 of the network can't be exported: .*bessel_j0"):
        export_onnx(Network(), tmp_path / "a.onnx")
    assert not list(tmp_path.iterdir())


def test_files_of_others_and_of_newer_versions_are_refused(exported, tmp_path):
    newer = dataclasses.replace(exported.metadata, format=FORMAT + 1, stereokit_version="99.0")
    for text, message in (
        (newer.to_json(), f"written by stereokit 99.0 in format {FORMAT + 1}; this is stereokit {__version__}"),
        ("{", "damaged"),
        ('{"format": 1}', "damaged"),
    ):
        with pytest.raises(CheckpointError, match=message):
            Predictor(saying(exported.path, text, tmp_path))
    model = onnx.load(exported.path)
    del model.metadata_props[:]
    onnx.save(model, tmp_path / "other.onnx")
    with pytest.raises(CheckpointError, match=r"was not written by stereokit"):
        Predictor(tmp_path / "other.onnx")


def small(overrides):
    """The overrides of an ablation row, made to fit few levels."""
    regression = overrides.get("regression")
    if regression is not None:
        regression = {**regression, "k": min(regression["k"], 16), "test_k": regression["test_k"]}
        return {**overrides, "regression": regression}
    return dict(overrides)


@pytest.mark.filterwarnings("ignore:Specified provider")
def test_a_device_whose_libraries_do_not_load_is_refused(exported, monkeypatch):
    from stereokit.backends.onnxruntime import OnnxRuntimeBackend

    # a build for CUDA on a machine without its libraries goes on with the CPU
    monkeypatch.setattr(OnnxRuntimeBackend, "_choose", staticmethod(lambda device, available: torch.device("cuda")))
    with pytest.raises(ConfigError, match="can't use device 'cuda' here, though built for it"):
        OnnxRuntimeBackend(exported.path)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["coex", "psmnet", "gcnet"])
def test_every_network_is_exported_for_any_size(name, tmp_path):
    export_onnx(settle(build_model(name, max_disparity=64)), tmp_path / "a.onnx")
    kinds = check_ready_for_tensorrt(tmp_path / "a.onnx")
    assert kinds["TopK"] == (1 if name == "coex" else 0)


@pytest.mark.slow
@pytest.mark.parametrize("row", ABLATION, ids=lambda row: f"{row.table}-{row.epe}")
def test_every_row_of_the_ablation_is_exported(row, tmp_path):
    model = settle(build_model(row.model, max_disparity=64, **small(row.overrides)))
    export_onnx(model, tmp_path / "a.onnx", size=(64, 96))
    check_ready_for_tensorrt(tmp_path / "a.onnx")
