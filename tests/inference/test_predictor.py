import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from stereokit import ConfigError, InputError, StereoOutput, build_model
from stereokit.backends.eager import TorchBackend
from stereokit.backends.estimate import Estimate
from stereokit.cameras.rectification import rectify
from stereokit.cameras.rendering import Plane, RigRenderer, example_rig
from stereokit.data import read_disparity, read_image
from stereokit.errors import CheckpointError
from stereokit.inference import DisparityResult, Predictor, output_paths
from stereokit.inference.planning import LARGE
from stereokit.runtime.device import choose_device
from stereokit.runtime.memory import estimate_memory
from tests.shared import SHARED, needs_shared


class ColumnNet(nn.Module):
    """Any module with the outer contract: says how bright the left image is, in hundreds."""

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        scale = 100 / 255 if left.dtype == torch.uint8 else 100
        return StereoOutput(left.float().mean(1) * scale)


@pytest.fixture(scope="module")
def coex() -> Predictor:
    torch.manual_seed(0)
    return Predictor(build_model("coex", max_disparity=64), device="cpu")


@pytest.mark.parametrize("size", [(32, 32), (33, 47), (61, 130)])
def test_any_size_from_32_up_gives_a_map_of_that_size(coex: Predictor, size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    left, right = rng.integers(0, 256, (2, *size, 3), dtype=np.uint8)
    result = coex(left, right)
    assert result.size == result.disparity.shape == result.confidence.shape == size
    assert result.disparity.dtype == result.confidence.dtype == np.float32
    assert np.isfinite(result.disparity).all()
    assert 0 <= result.disparity.min() <= result.disparity.max() < 64
    assert 0 <= result.confidence.min() <= result.confidence.max() <= 1
    assert result.seconds > 0


def test_the_result_is_that_of_the_network(coex: Predictor) -> None:
    left, right = torch.rand(2, 1, 3, 40, 64)
    with torch.inference_mode():
        expected = coex.model(left, right)
    result = coex(left, right)
    np.testing.assert_allclose(result.disparity, expected.disparity[0], atol=1e-3)
    np.testing.assert_allclose(result.confidence, expected.confidence[0], atol=1e-4)


def test_a_network_of_ones_own_needs_no_confidence() -> None:
    result = Predictor(ColumnNet(), "cpu")(np.full((40, 50), 0.5, np.float32), np.zeros((40, 50), np.float32))
    np.testing.assert_allclose(result.disparity, 50)
    assert result.confidence is None


def test_a_large_pair_runs_where_its_memory_can_not_be_estimated_unless_a_limit_was_given() -> None:
    class ReadsValues(ColumnNet):
        def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
            return super().forward(left if float(left.sum()) > 0 else right, right)

    left, right = np.full((2, LARGE // 800 + 1, 800), 0.5, np.float32)
    np.testing.assert_allclose(Predictor(ReadsValues(), "cpu")(left, right).disparity, 50)
    with pytest.raises(ConfigError, match="memory that ReadsValues needs can't be found out"):
        Predictor(ReadsValues(), "cpu", max_memory="1TB")(left, right)


def test_a_small_pair_is_checked_too_where_memory_is_short(monkeypatch: pytest.MonkeyPatch) -> None:
    predict = Predictor(build_model("gcnet", max_disparity=64), "cpu")
    for module in ("planning", "bounds"):
        monkeypatch.setattr(f"stereokit.inference.{module}.available_memory", lambda device: 50_000_000)
    with pytest.raises(InputError, match=r"256 x 128 pixels needs about \d+ MiB of memory, 48 MiB are free on cpu"):
        predict(*np.zeros((2, 128, 256, 3), np.float32))


def test_a_network_that_may_need_anything_is_measured_where_memory_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("planning", "bounds"):
        monkeypatch.setattr(f"stereokit.inference.{module}.available_memory", lambda device: 8_000_000_000)
    pair = np.zeros((2, 200, 200, 3), np.float32)
    measured = []
    monkeypatch.setattr(
        "stereokit.inference.bounds.estimate_memory", lambda *arguments: measured.append(arguments) or 1000
    )
    Predictor(ColumnNet(), "cpu")(*pair)
    assert len(measured) == 1
    Predictor(build_model("coex", max_disparity=64), "cpu")(*pair)
    assert len(measured) == 1
    # GC-Net's need grows with D
    wide = ColumnNet()
    wide.max_disparity = 192 * 9
    Predictor(wide, "cpu")(*pair)
    assert len(measured) == 2


@pytest.mark.parametrize("error", [torch.OutOfMemoryError("full"), RuntimeError("x: can't allocate memory: 9")])
@pytest.mark.parametrize("limits", [{}, {"max_memory": "100GB"}])
def test_memory_that_runs_out_is_one_line(error: RuntimeError, limits: dict[str, str]) -> None:
    class Greedy(ColumnNet):
        def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
            if left.device.type == "cpu" and type(left) is Tensor:
                raise error
            return super().forward(left, right)

    left, right = np.zeros((2, 40, 50), np.float32)
    with pytest.raises(InputError, match="50 x 40 pixels does not fit into the memory of cpu"):
        Predictor(Greedy(), "cpu", **limits)(left, right)


@pytest.mark.slow
def test_what_is_prepared_once_is_timed_apart_from_tiles_too() -> None:
    model = build_model("coex", max_disparity=32).eval()
    left, right = np.random.default_rng(0).random((2, 128, 512, 3))
    predict = Predictor(model, "cpu", max_memory=int(0.8 * estimate_memory(model, 128, 512)), too_large="tile")
    first, again = predict(left, right), predict(left, right)
    assert first.preparation_seconds > again.preparation_seconds == 0
    assert min(first.seconds, again.seconds) > 0


def test_threads_that_share_a_predictor_are_timed_each_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    predict = Predictor(ColumnNet(), "cpu")
    # so that no thread plans this size
    predict(*np.zeros((2, 40, 50), np.float32))
    together = threading.Barrier(4, timeout=60)

    def prepare(backend: TorchBackend, left: Tensor, right: Tensor) -> float:
        return 1000 * float(left.mean())

    def match(backend: TorchBackend, left: Tensor, right: Tensor) -> Estimate:
        # all are in the middle of a pair at once
        together.wait()
        return Estimate(100 * left.mean(1).numpy(), None)

    monkeypatch.setattr(TorchBackend, "prepare", prepare)
    monkeypatch.setattr(TorchBackend, "__call__", match)
    levels = [0.1, 0.2, 0.3, 0.4]
    with ThreadPoolExecutor(4) as pool:
        results = list(pool.map(lambda level: predict(*np.full((2, 40, 50), level, np.float32)), levels))
    for level, result in zip(levels, results, strict=True):
        np.testing.assert_allclose(result.disparity, 100 * level, rtol=1e-5)
        assert result.preparation_seconds == pytest.approx(1000 * level, rel=1e-4)


@pytest.mark.parametrize("limits", [{}, {"max_memory": "100GB"}])
@pytest.mark.parametrize("scale", [0.5, 2])
def test_disparities_of_another_resolution_are_those_of_the_pair(limits: dict[str, str], scale: float) -> None:
    left, right = np.full((2, 80, 120), 0.25, np.float32)
    result = Predictor(ColumnNet(), "cpu", scale=scale, **limits)(left, right)
    assert result.size == (80, 120)
    np.testing.assert_allclose(result.disparity, 25 / scale)
    with pytest.raises(InputError, match=r"use at least 0\.4"):
        Predictor(ColumnNet(), "cpu", scale=0.3)(left, right)
    with pytest.raises(InputError, match=r"at scale 1\.5, .*: a pair of 180 x 120 pixels needs about"):
        Predictor(ColumnNet(), "cpu", scale=1.5, max_memory=1000)(left, right)
    for wrong in (0, -1, 9, float("nan"), "2", None):
        with pytest.raises(ConfigError, match="not above 0 and at most 8"):
            Predictor(ColumnNet(), "cpu", scale=wrong)


def test_it_reads_a_saved_network(tmp_path: Path, coex: Predictor) -> None:
    coex.model.save_pretrained(tmp_path)
    image = np.random.default_rng(0).random((40, 50, 3))
    np.testing.assert_array_equal(Predictor(tmp_path, "cpu")(image, image).disparity, coex(image, image).disparity)
    with pytest.raises(CheckpointError, match="nowhere"):
        Predictor(tmp_path / "nowhere")
    with pytest.raises(CheckpointError, match="use the folder that save_pretrained wrote"):
        Predictor(tmp_path / "model.safetensors")
    (tmp_path / "network.pt2").touch()
    with pytest.raises(CheckpointError, match=r"torch\.export\.load reads; .* \.onnx or \.xml, or the network itself"):
        Predictor(tmp_path / "network.pt2")
    with pytest.raises(ConfigError, match="no weights for 'gcnet'"):
        Predictor("gcnet")
    with pytest.raises(ConfigError, match="got NoneType"):
        Predictor(None)  # type: ignore[arg-type]


def test_a_saved_network_can_be_read_by_others(tmp_path: Path, coex: Predictor) -> None:
    coex.model.save_pretrained(tmp_path)
    (tmp_path / "plain").write_text("")
    modes = {path.name: path.stat().st_mode for path in tmp_path.iterdir()}
    assert len(set(modes.values())) == 1, modes


def test_pixels_without_a_finite_disparity_are_counted(tmp_path: Path) -> None:
    disparity = np.full((40, 60), 5, np.float32)
    disparity[0, :3] = np.nan, np.inf, -np.inf
    holes = DisparityResult(disparity, None, 0.1)
    assert holes.invalid == 3
    assert len(holes.save_all(tmp_path, "holes")) == 4


def test_a_folder_that_can_not_be_made_is_refused(tmp_path: Path, coex: Predictor) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file' can't be made"):
        result().save_all(tmp_path / "file", "x")
    with pytest.raises(InputError, match="file' can't be made"):
        coex.model.save_pretrained(tmp_path / "file")


def test_small_and_unequal_images_are_refused(coex: Predictor) -> None:
    with pytest.raises(InputError, match="40 x 31 pixels; at least 32 x 32"):
        coex(np.zeros((31, 40), np.uint8), np.zeros((31, 40), np.uint8))
    with pytest.raises(InputError, match="one size"):
        coex(np.zeros((32, 40), np.uint8), np.zeros((32, 41), np.uint8))


def test_unknown_and_absent_devices_are_refused() -> None:
    for device in ("tpu9", "cuda:99", None, 2.5):
        with pytest.raises(ConfigError, match=f"device '{device}' can't be used; use 'auto' or 'cpu'"):
            choose_device(device)  # type: ignore[arg-type]
    assert choose_device("auto").type in {"cpu", "cuda", "mps", "xpu"}


def result() -> DisparityResult:
    rng = np.random.default_rng(0)
    disparity, confidence = rng.random((2, 40, 60), dtype=np.float32)
    return DisparityResult(disparity * 100, confidence, seconds=0.1)


def test_all_formats_hold_the_same_disparity(tmp_path: Path) -> None:
    written = result().save_all(tmp_path / "new" / "folder", "scene")
    assert written == output_paths(tmp_path / "new" / "folder", "scene")
    png, pfm, npz, picture = written
    np.testing.assert_array_equal(read_disparity(pfm), result().disparity)
    np.testing.assert_array_equal(read_disparity(npz), result().disparity)
    np.testing.assert_allclose(read_disparity(png), result().disparity, atol=0.5 / 256 + 1e-6)
    with np.load(npz) as arrays:
        np.testing.assert_array_equal(arrays["confidence"], result().confidence)
    assert read_image(picture).shape[0] > 40


def test_existing_files_are_kept_unless_told_otherwise(tmp_path: Path) -> None:
    picture = output_paths(tmp_path, "scene")[-1]
    picture.write_text("precious")
    with pytest.raises(InputError, match="exists already"):
        result().save_all(tmp_path, "scene")
    assert [path.name for path in tmp_path.iterdir()] == [picture.name]
    assert picture.read_text() == "precious"
    result().save_all(tmp_path, "scene", overwrite=True)
    assert read_image(picture).dtype == np.uint8


@pytest.mark.parametrize("value", [300, -0.1])
def test_a_disparity_beyond_kittis_encoding_is_left_out_of_the_png(tmp_path: Path, value: float) -> None:
    result().save_all(tmp_path, "wide")
    wide = DisparityResult(np.full((40, 60), value, np.float32), None, 0.1)
    _, *others = output_paths(tmp_path, "wide")
    assert wide.save_all(tmp_path, "wide", overwrite=True) == others
    # no PNG of the result before is left beside them
    assert sorted(tmp_path.iterdir()) == sorted(others)
    with pytest.raises(InputError, match="255"):
        wide.save(tmp_path / "x.png")


@needs_shared
def test_the_pilot_matches_a_real_pair() -> None:
    from stereokit import load_published

    scene = SHARED / "data/real/middlebury/teddy"
    predictor = Predictor(load_published(SHARED / "golden/coex_pilot.ckpt", channel_order="rgb"))
    truth = read_disparity(scene / "groundtruth.png", scale=4)
    error = np.abs(predictor(scene / "imL.png", scene / "imR.png").disparity - truth)[np.isfinite(truth)]
    assert 100 * (error > 3).mean() == pytest.approx(6.0, abs=0.15)


@pytest.mark.slow
def test_a_pair_that_memory_can_not_hold_is_refused_or_cut_before_it_starts() -> None:
    model = build_model("coex", max_disparity=32).eval()
    left, right = np.random.default_rng(0).random((2, 320, 700, 3))
    allowed = int(0.7 * estimate_memory(model, 320, 700))
    with pytest.raises(InputError, match=r"700 x 320"):
        Predictor(model, "cpu", max_memory=1_000_000)(left, right)
    whole = Predictor(model, "cpu", max_memory="100GB")(left, right)
    for too_large in ("tile", "reduce"):
        result = Predictor(model, "cpu", max_memory=allowed, too_large=too_large)(left, right)
        assert result.size == whole.size == (320, 700)
        assert result.confidence is not None
        assert result.confidence.shape == (320, 700)
        assert result.disparity.dtype == np.float32
        assert not np.array_equal(result.disparity, whole.disparity)
    with pytest.raises(ConfigError, match="'error', 'tile' or 'reduce'"):
        Predictor(model, "cpu", too_large="shrink")  # type: ignore[arg-type]


def test_views_of_a_rig_are_rectified_on_the_way(tmp_path):
    rig = example_rig(size=(96, 128), baseline=0.02)
    left, right = RigRenderer(rig, samples=1)(_boards(), seed=0)
    rig.write(tmp_path / "rig.json")
    network = build_model("coex", max_disparity=64)
    predict = Predictor(network, rig=tmp_path / "rig.json")
    result = predict(left, right)
    rectification = rectify(rig)
    first, second = rectification(left, right)
    plain = Predictor(network)(first, second)
    seen = rectification.seen(plain.disparity)
    assert 0.5 < seen.mean() < 1
    np.testing.assert_array_equal(result.disparity[seen], plain.disparity[seen])
    assert np.isnan(result.disparity[~seen]).all()
    assert (result.confidence[~seen] == 0).all()
    np.testing.assert_array_equal(predict.match(first, second).disparity, plain.disparity)
    assert predict.rectification.calibration == rectification.calibration
    with pytest.raises(InputError, match="the left view has 128 x 95 pixels; the rig is for 128 x 96"):
        predict(left[1:], right[1:])


def _boards():
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (200, 300, 3), np.uint8)
    return [Plane(picture, 200.0, np.eye(3), np.array([0, 0, 1.0]))]
