"""Configurations that somebody damaged, or made to do harm."""

import json
import shutil

import pytest

from stereokit import CheckpointError, ConfigError, StereoNetwork, build_model


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved")
    build_model("coex", max_disparity=32).save_pretrained(folder)
    return folder


@pytest.fixture
def folder(saved, tmp_path):
    return shutil.copytree(saved, tmp_path / "network")


@pytest.mark.parametrize(
    ("slot", "change", "words"),
    [
        ("backbone", {"pretrained": True}, "asks for other weights"),
        ("backbone", {"encoder": 5}, "can't be built"),
        ("backbone", {"stem_channels": [2**40, 48]}, "can't be built"),
        ("backbone", {"stem_channels": [2**20, 48]}, "does not fit"),
        ("aggregation", {"channels": [6000, 16, 32, 48]}, "does not fit"),
        ("aggregation", {"channels": "8888"}, "can't be built"),
        ("cost", {"projection": [48, None]}, "can't be built"),
    ],
)
def test_a_damaged_configuration_is_one_line_and_takes_no_memory(folder, slot, change, words):
    file = folder / "config.json"
    config = json.loads(file.read_text())
    config["network"][slot] |= change
    file.write_text(json.dumps(config))
    with pytest.raises((CheckpointError, ConfigError)) as refusal:
        StereoNetwork.from_pretrained(folder)
    message = str(refusal.value)
    assert words in message
    assert "\n" not in message
    assert len(message) < 600


def test_of_many_weights_that_do_not_fit_a_few_are_named(folder):
    file = folder / "config.json"
    config = json.loads(file.read_text())
    config["network"]["backbone"] = {"name": "unet", "encoder": "resnet18", "stem_channels": [32, 48]}
    file.write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=r"and \d+ more") as refusal:
        StereoNetwork.from_pretrained(folder)
    assert len(str(refusal.value)) < 600
