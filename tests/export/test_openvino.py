from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stereokit import ConfigError, InputError, Predictor, build_model
from stereokit.export import export_openvino
from stereokit.export.checking import random_pair
from stereokit.export.quantization import outside_convolutions
from tests.optimize.networks import settle

openvino = pytest.importorskip("openvino")
pytest.importorskip("onnxscript")


@pytest.fixture(scope="module")
def exported(tiny, tmp_path_factory):
    return export_openvino(tiny, tmp_path_factory.mktemp("openvino") / "tiny.xml", precision="bfloat16")


@pytest.mark.parametrize("size", [(32, 32), (33, 47), (64, 96)])
def test_the_predictor_runs_it_as_it_runs_the_network(exported, tiny, size):
    left, right = np.random.default_rng(0).integers(0, 256, (2, *size, 3), dtype=np.uint8)
    predict = Predictor(exported.path)
    result, expected = predict(left, right), Predictor(tiny, "cpu")(left, right)
    # bfloat16 has 8 bits, of at most 16 px
    np.testing.assert_allclose(result.disparity, expected.disparity, atol=0.1)
    exact = Predictor(exported.path, precision="float32")
    assert exact.backend.precision == "float32"
    np.testing.assert_allclose(exact(left, right).disparity, expected.disparity, atol=1e-4)
    np.testing.assert_allclose(exact(left, right).confidence, expected.confidence, atol=1e-5)


def test_the_file_says_what_it_holds(exported):
    metadata = Predictor(exported.path).backend.metadata
    assert metadata == exported.metadata
    assert (metadata.precision, metadata.opset, metadata.size, metadata.max_disparity) == ("bfloat16", None, None, 16)
    assert sorted(path.name for path in exported.path.parent.iterdir()) == ["tiny.bin", "tiny.xml"]


def test_results_outlive_the_next_pair(exported):
    predict = Predictor(exported.path)
    first = predict(*random_pair(40, 50, seed=1))
    kept = first.disparity.copy()
    predict(*random_pair(40, 50, seed=2))
    np.testing.assert_array_equal(first.disparity, kept)


def test_threads_get_the_results_of_their_own_pairs(exported):
    predict = Predictor(exported.path)
    pairs = [random_pair(64, 96, seed) for seed in range(4)]
    alone = [predict(*pair).disparity for pair in pairs]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda number: predict(*pairs[number % 4]).disparity, range(40)))
    for number, disparity in enumerate(together):
        np.testing.assert_array_equal(disparity, alone[number % 4])


def test_int8_is_near_and_says_how_near(tiny, tmp_path):
    pytest.importorskip("nncf")
    pairs = [random_pair(64, 96, seed) for seed in range(4)]
    report = export_openvino(tiny, tmp_path / "a.xml", precision="int8", calibration=pairs)
    assert Predictor(tmp_path / "a.xml").backend.precision == "int8"
    assert len(report.differences) == 4
    assert "calibrated on 4 pairs; 20 to 300 are usual" in str(report)
    assert all(0 < difference.mean < 0.2 for difference in report.differences)
    graph = openvino.Core().read_model(tmp_path / "a.xml")
    quantizers = [op for op in graph.get_ops() if op.get_type_name() == "FakeQuantize"]
    outside = [op for op in quantizers if op.get_friendly_name() in outside_convolutions(graph)]
    # one behind the regression would cut off disparities above those of the calibration
    assert [port.get_node().get_type_name() for op in outside for port in op.output(0).get_target_inputs()] == [
        "Convolution"
    ]


def test_bad_requests_are_refused_and_leave_nothing(tiny, tmp_path):
    pair = [random_pair(64, 96)]
    for arguments, error, message in (
        ({"precision": "int8"}, ConfigError, "int8 needs pairs .*--calibrate synthetic"),
        ({"precision": "int8", "calibration": []}, ConfigError, "int8 needs pairs"),
        ({"precision": "int4"}, ConfigError, "use float32, bfloat16, int8"),
        ({"calibration": pair}, ConfigError, "calibration is for precision 'int8' alone"),
        (
            {"precision": "int8", "calibration": pair, "size": (32, 64)},
            InputError,
            "is 96 x 64 pixels, but the export is for 64 x 32",
        ),
    ):
        with pytest.raises(error, match=message):
            export_openvino(tiny, tmp_path / "a.xml", **arguments)
    with pytest.raises(InputError, match=r"does not end in \.xml"):
        export_openvino(tiny, tmp_path / "a.onnx")
    (tmp_path / "a.bin").write_text("precious")
    with pytest.raises(InputError, match=r"a\.bin' exists already"):
        export_openvino(tiny, tmp_path / "a.xml")
    assert [path.name for path in tmp_path.iterdir()] == ["a.bin"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["coex", "psmnet", "gcnet"])
def test_the_networks_are_exported_for_any_size(name, tmp_path):
    export_openvino(settle(build_model(name, max_disparity=64)), tmp_path / "a.xml")
