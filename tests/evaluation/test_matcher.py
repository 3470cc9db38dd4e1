import hashlib

import numpy as np
import pytest
import torch
from torch import nn

from stereokit import StereoModel, StereoOutput, build_model, list_weights
from stereokit.errors import InputError
from stereokit.evaluation import BatchMatcher, NetworkMatcher, SemiGlobalMatcher, describe_matcher
from stereokit.inference import Predictor


@pytest.fixture(scope="module")
def predictor():
    torch.manual_seed(0)
    return Predictor(build_model("coex", max_disparity=64), device="cpu")


def test_a_batch_gives_what_single_pairs_give_in_one_pass(predictor, monkeypatch):
    rng = np.random.default_rng(0)
    lefts, rights = rng.integers(0, 256, (2, 3, 40, 50, 3), dtype=np.uint8)
    matcher = NetworkMatcher(predictor)
    assert isinstance(matcher, BatchMatcher)
    alone = [predictor(left, right).disparity for left, right in zip(lefts, rights, strict=True)]
    shapes = []
    forward = StereoModel.forward
    monkeypatch.setattr(
        StereoModel, "forward", lambda model, left, right: shapes.append(left.shape) or forward(model, left, right)
    )
    together = matcher.match_batch(lefts, rights)
    assert shapes == [(3, 3, 40, 50)]
    np.testing.assert_allclose(together, alone, atol=1e-2)
    np.testing.assert_array_equal(matcher(lefts[0], rights[0]), alone[0])


def test_a_network_is_described_by_its_configuration_and_weights(predictor, tmp_path):
    predictor.model.save_pretrained(tmp_path)
    parts = describe_matcher(NetworkMatcher(predictor, weights=tmp_path))
    assert parts["configuration"] == predictor.model.config
    assert parts["weights_file_sha256"] == hashlib.sha256((tmp_path / "model.safetensors").read_bytes()).hexdigest()
    loaded = NetworkMatcher(Predictor(tmp_path, "cpu"))
    assert loaded.describe()["weights_sha256"] == parts["weights_sha256"]
    with torch.no_grad():
        next(loaded.predictor.model.parameters()).view(-1)[0] += 1
    assert loaded.describe()["weights_sha256"] != parts["weights_sha256"]


def test_openvino_files_are_named_by_their_weights_too(predictor, tmp_path):
    for name in ("net.xml", "net.bin"):
        (tmp_path / name).write_text(name)
    parts = NetworkMatcher(predictor, weights=tmp_path / "net.xml").describe()
    assert parts["graph_file_sha256"] == hashlib.sha256(b"net.xml").hexdigest()
    assert parts["weights_file_sha256"] == hashlib.sha256(b"net.bin").hexdigest()


def test_what_lies_on_disk_goes_before_the_librarys_weights(predictor, tmp_path, monkeypatch):
    [name, *_] = list_weights()
    monkeypatch.chdir(tmp_path)
    predictor.model.save_pretrained(name)
    parts = NetworkMatcher(predictor, weights=name).describe()
    own = (tmp_path / name / "model.safetensors").read_bytes()
    assert parts["weights_file_sha256"] == hashlib.sha256(own).hexdigest()


def test_limits_are_recorded_and_preparation_is_timed_apart():
    images = np.zeros((1, 40, 50, 3), np.uint8)
    matcher = NetworkMatcher(Predictor(build_model("coex", max_disparity=32), "cpu", scale=0.8))
    matcher.match_batch(images, images)
    first = matcher.preparation_seconds
    matcher.match_batch(images, images)
    assert first > matcher.preparation_seconds == 0
    assert matcher.describe()["limits"] == {"scale": 0.8, "max_memory": None, "too_large": "error"}


class Plain(nn.Module):
    def forward(self, left, right):
        return StereoOutput(left.float().mean(1))


def test_a_network_of_ones_own_is_described_by_its_class():
    matcher = NetworkMatcher(Predictor(Plain(), "cpu"))
    assert matcher(np.full((40, 50, 3), 7, np.uint8), np.zeros((40, 50, 3), np.uint8))[0, 0] == 7
    assert matcher.describe()["class"].endswith("test_matcher.Plain")


@pytest.mark.parametrize("settings", [{"scale": 0.5}, {"max_memory": "1GB"}])
def test_a_predictor_that_scales_or_cuts_is_asked_for_each_pair(predictor, settings):
    images = np.random.default_rng(0).integers(0, 256, (2, 80, 100, 3), dtype=np.uint8)
    bounded = Predictor(predictor.model, "cpu", **settings)
    alone = bounded(*images).disparity
    for disparity in NetworkMatcher(bounded).match_batch([images[0]] * 2, [images[1]] * 2):
        np.testing.assert_array_equal(disparity, alone)
    assert ("scale" in settings) == (np.abs(alone - predictor(*images).disparity).max() > 0.1)


def test_too_large_a_batch_says_what_would_do():
    class Greedy(nn.Module):
        def forward(self, left, right):
            raise torch.OutOfMemoryError("no memory")

    images = np.zeros((2, 40, 50, 3), np.uint8)
    with pytest.raises(InputError, match=r"2 pairs of 50 x 40 pixels .* smaller --batch"):
        NetworkMatcher(Predictor(Greedy(), "cpu")).match_batch(images, images)


def test_other_matchers_are_described_by_parameters_or_name():
    assert describe_matcher(SemiGlobalMatcher(paths=5))["paths"] == 5
    assert describe_matcher(np.subtract)["name"].endswith("subtract")
    assert describe_matcher(Plain())["name"].endswith("Plain")
