import itertools
import json
import math
import sys

import cv2
import numpy as np
import pytest
import torch

from stereokit.data import write_image
from stereokit.data.datasets import open_dataset
from stereokit.errors import ConfigError, InputError
from stereokit.evaluation import evaluate
from stereokit.runtime.provenance import file_sha256
from tests.evaluation.scenes import SIZE, Batches, constant, save_kitti, save_scene


@pytest.fixture
def three(tmp_path):
    """Three scenes whose disparity is 4, 6 and 9."""
    for number, disparity in enumerate((4, 6, 9)):
        save_scene(tmp_path, f"scene{number}", disparity)
    return f"folder:{tmp_path}"


def test_numbers_are_those_of_the_definition(three):
    [result] = evaluate(constant(7.5), [three], taus=(1, 3)).datasets
    errors = np.array([3.5, 1.5, 1.5])
    pixels = np.array([SIZE[0] * (SIZE[1] - d) for d in (4, 6, 9)])
    assert [pair.metrics["epe"] for pair in result.pairs] == errors.tolist()
    assert result.metrics["epe"] == pytest.approx((errors * pixels).sum() / pixels.sum())
    assert result.metrics["epe_per_image"] == pytest.approx(errors.mean())
    assert result.metrics["bad_3_per_image"] == pytest.approx(100 / 3)
    assert result.metrics["pixels"] == pixels.sum()
    assert [(pair.name, pair.width, pair.height) for pair in result.pairs] == [
        (f"scene{n}", SIZE[1], SIZE[0]) for n in range(3)
    ]


def test_a_ceiling_leaves_out_far_truth_and_is_recorded(three):
    evaluation = evaluate(constant(7.5), [three], max_disparity=5)
    metrics = evaluation.datasets[0].metrics
    assert metrics["images"] == 1
    assert metrics["images_without_pixels"] == 2
    assert evaluation.datasets[0].pairs[2].metrics["epe"] is None
    assert evaluation.settings["max_disparity"] == 5
    assert "below 5 px" in evaluation.masks["counted"]


def test_occlusion_masks_and_object_maps_reach_the_metrics(tmp_path):
    save_kitti(tmp_path, "2015", "training", [0])
    objects = tmp_path / "training/obj_map"
    objects.mkdir()
    image = np.zeros(SIZE, np.uint8)
    image[:10] = 3
    cv2.imwrite(str(objects / "000000_10.png"), image)
    metrics = evaluate(constant(5), [f"kitti2015:{tmp_path}"]).datasets[0].metrics
    assert metrics["pixels_fg"] == 10 * SIZE[1]
    assert metrics["pixels_noc"] == SIZE[0] * SIZE[1]
    assert metrics["pixels_occ"] == 0
    assert metrics["epe_occ"] is None


def test_predictions_that_are_not_finite_are_counted(three):
    def match(left, right):
        disparity = np.full(left.shape[:2], 6.0)
        disparity[0] = np.nan
        disparity[1] = np.inf
        return disparity

    [result] = evaluate(match, [three]).datasets
    assert {pair.invalid_pixels for pair in result.pairs} == {2 * SIZE[1]}
    scene = result.pairs[1].metrics
    assert scene["invalid_predictions"] == 2 * (SIZE[1] - 6)
    assert scene["bad_3"] == pytest.approx(100 * 2 / SIZE[0])
    assert scene["epe"] == 0


@pytest.mark.parametrize(
    ("prediction", "message"),
    [
        (np.zeros((3, 4)), r"scene0.*shape \(3, 4\); expected that of the images, \(40, 60\)"),
        (np.zeros((1, *SIZE)), r"scene0.*shape \(1, 40, 60\)"),
        (np.zeros(SIZE, bool), "scene0.*bool; expected disparity"),
        (None, "scene0.*object; expected disparity"),
    ],
)
def test_a_prediction_that_is_no_map_of_the_images_size_is_refused(three, prediction, message):
    with pytest.raises(InputError, match=message):
        evaluate(lambda left, right: prediction, [three])


def test_tensors_and_whole_numbers_are_taken(three):
    for prediction in (torch.full(SIZE, 6, dtype=torch.bfloat16), np.full(SIZE, 6, np.int32)):
        result = evaluate(lambda left, right, prediction=prediction: prediction, [three])
        assert result.datasets[0].pairs[1].metrics["epe"] == 0


def test_broken_data_is_an_error_and_never_left_out(tmp_path, three):
    (tmp_path / "scene1/right.png").unlink()
    with pytest.raises(InputError, match=r"right\.png"):
        evaluate(constant(5), [three])
    write_image(tmp_path / "scene1/right.png", np.zeros((SIZE[0], SIZE[1] + 1, 3), np.uint8))
    with pytest.raises(InputError, match="'scene1': the right image is 61 x 40 pixels, the left image 60 x 40"):
        evaluate(constant(5), [three])


def test_pairs_without_truth_are_matched_and_have_no_numbers(tmp_path):
    save_kitti(tmp_path, "2012", "testing")
    [result] = evaluate(constant(5), [f"kitti2012/testing:{tmp_path}"]).datasets
    assert [pair.metrics for pair in result.pairs] == [None, None]
    assert result.metrics["epe"] is None
    assert result.metrics["images"] == 0


def test_limit_takes_the_first_of_each_data_set(three, tmp_path):
    save_kitti(tmp_path / "kitti", "2012", "training")
    evaluation = evaluate(constant(5), [three, f"kitti2012:{tmp_path / 'kitti'}"], limit=1)
    assert [[pair.name for pair in d.pairs] for d in evaluation.datasets] == [["scene0"], ["000000_10"]]
    assert [d.available for d in evaluation.datasets] == [3, 2]


def test_opened_data_sets_go_by_any_name(three):
    evaluation = evaluate(constant(5), {"mine": open_dataset(three)[1:]})
    assert [(d.name, len(d.pairs)) for d in evaluation.datasets] == [("mine", 2)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"limit": 0}, "limit is 0; expected at least 1"),
        ({"batch": 0}, "batch is 0"),
        ({"batch": 2}, "one pair at a time"),
        ({"warmup": -1}, "warmup is -1"),
        ({"taus": [-1]}, "tau is -1"),
        ({"max_disparity": 0}, "max_disparity is 0"),
    ],
)
def test_options_that_can_not_be_are_refused(three, arguments, message):
    with pytest.raises((ConfigError, InputError), match=message):
        evaluate(constant(5), [three], **arguments)


def test_no_data_set_and_the_same_twice_are_refused(three):
    with pytest.raises(InputError, match="no data set"):
        evaluate(constant(5), [])
    with pytest.raises(InputError, match="expected each once"):
        evaluate(constant(5), [three, three])


@pytest.mark.parametrize("batch", [1, 2, 3, 8])
def test_batches_hold_equal_sizes_and_change_no_number(tmp_path, batch):
    sizes = [(40, 60), (41, 60), (40, 60), (41, 60), (40, 60), (42, 60), (43, 60), (44, 60), (40, 60)]
    for number, size in enumerate(sizes):
        save_scene(tmp_path, f"scene{number}", size=size, seed=number)
    matcher = Batches()
    [result] = evaluate(matcher, [f"folder:{tmp_path}"], batch=batch, warmup=0).datasets
    [alone] = evaluate(lambda left, right: left[..., 0].astype(np.float32), [f"folder:{tmp_path}"]).datasets
    assert [pair.metrics for pair in result.pairs] == [pair.metrics for pair in alone.pairs]
    assert result.metrics == pytest.approx(alone.metrics)
    assert sum(matcher.sizes) == len(sizes)
    assert max(matcher.sizes) == min(batch, 4 if batch == 8 else batch)


def test_the_clock_excludes_the_warm_up_and_shares_a_batch(three, monkeypatch):
    now = 0

    class Slow(Batches):
        def match_batch(self, lefts, rights):
            nonlocal now
            now += 15 if self.sizes else 60
            return super().match_batch(lefts, rights)

    monkeypatch.setattr(sys.modules[evaluate.__module__], "synchronised_clock", lambda: now)
    matcher = Slow()
    [result] = evaluate(matcher, [three], batch=3).datasets
    assert matcher.sizes == [3, 3]
    assert result.median_seconds == 5


def test_a_matcher_that_can_not_be_described_is_refused_before_it_matches(three):
    matcher = constant(1)
    matcher.describe = lambda: file_sha256("gone.safetensors")
    seen = []
    with pytest.raises(InputError, match="gone"):
        evaluate(matcher, [three], observers=[lambda *_: seen.append(1)])
    assert not seen


def test_what_is_needed_once_is_not_on_the_clock(three, monkeypatch):
    now = itertools.count(step=3.0)
    monkeypatch.setattr(sys.modules[evaluate.__module__], "synchronised_clock", lambda: next(now))
    match = constant(1)
    match.preparation_seconds = 2.0
    assert evaluate(match, [three]).datasets[0].median_seconds == 1


def test_the_clock_waits_for_the_device(three, monkeypatch):
    calls = []
    monkeypatch.setattr(torch.accelerator, "is_available", lambda: True)
    monkeypatch.setattr(torch.accelerator, "synchronize", lambda: calls.append("wait"))

    def match(left, right):
        calls.append("match")
        return np.ones(left.shape[:2])

    evaluate(match, [three], warmup=0, limit=1)
    assert calls == ["wait", "match", "wait"]


def test_observers_see_every_pair_once(three):
    seen = []
    evaluate(constant(5), [three], observers=[lambda name, sample, disparity, pair: seen.append((name, pair.name))])
    assert seen == [(three, f"scene{n}") for n in range(3)]


def test_the_record_tells_how_to_repeat(three, tmp_path):
    evaluation = evaluate(constant(math.nan), [three], command="stereokit eval")
    record = json.loads(evaluation.to_json())
    assert record["model"] == {"matcher": "callable", "name": "tests.evaluation.scenes.constant.<locals>.match"}
    rules = {"taus": [1, 2, 3], "max_disparity": None, "min_disparity": 0}
    assert record["settings"] == {**rules, "limit": None, "batch": 1, "warmup": 1}
    assert {"python", "stereokit", "torch", "numpy"} <= record["versions"].keys()
    assert {"system", "processor", "cores", "torch_threads"} <= record["machine"].keys()
    assert record["command"] == "stereokit eval"
    [dataset] = record["datasets"]
    assert (dataset["name"], dataset["kind"], dataset["root"]) == (three, "folder", str(tmp_path))
    assert dataset["pairs"][0]["metrics"]["epe"] is None
    assert len(dataset["pairs"]) == dataset["available"] == 3
