import json
import re
import shutil
from types import SimpleNamespace

import huggingface_hub
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file
from torch.testing import assert_close

from stereokit import (
    CheckpointError,
    ConfigError,
    InputError,
    Predictor,
    StereoKitError,
    StereoModel,
    TopKSoftArgmin,
    build_model,
)
from stereokit.registry import COSTS
from stereokit.weights.folder import CONFIG_NAME, WEIGHTS_NAME, load_state


def small_coex(**overrides):
    """A CoEx with a quarter of the weights."""
    small = {"backbone": {"encoder": "mobilenetv2_035", "stem_channels": [4, 4]}, "cost": {"projection": [8, 8]}}
    return build_model("coex", **{"max_disparity": 32, **small, **overrides})


def scrambled(model):
    """Every weight and every statistic differs from what a new network has."""
    with torch.no_grad():
        for value in model.state_dict().values():
            value.copy_(torch.rand_like(value.float()) + 0.5)
    return model


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A folder with a saved network, and the network."""
    folder = tmp_path_factory.mktemp("saved") / "network"
    model = scrambled(small_coex()).eval()
    model.save_pretrained(folder)
    return folder, model


@pytest.fixture
def copy(saved, tmp_path):
    """A copy of the saved network, to be damaged."""
    return shutil.copytree(saved[0], tmp_path / "copy")


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        *((name, {"max_disparity": 64}) for name in ["coex", "psmnet", "gcnet"]),
        ("coex", {"backbone": "resnet18", "cost": "groupwise_correlation", "top_k": 3, "upsampler": "bilinear"}),
        ("psmnet", {"guidance": "gce", "max_disparity": 32}),
        ("gcnet", {"max_disparity": 32, "padding": "zeros", "mean": [0.5, 0.5, 0.5]}),
    ],
)
def test_a_network_comes_back_as_it_was(tmp_path, name, overrides):
    model = build_model(name, **overrides)
    for norm in model.modules():
        if isinstance(norm, torch.nn.BatchNorm2d | torch.nn.BatchNorm3d):
            torch.nn.init.normal_(norm.running_mean, std=0.1)
    model.save_pretrained(tmp_path / "network")
    loaded = StereoModel.from_pretrained(tmp_path / "network")
    assert loaded.config == model.config
    assert not loaded.training
    state, expected = loaded.state_dict(), model.state_dict()
    assert list(state) == list(expected)
    for key, value in expected.items():
        assert_close(state[key], value, rtol=0, atol=0)
    left, right = torch.rand(2, 1, 3, 32, 64)
    assert_close(loaded(left, right), model.eval()(left, right), rtol=0, atol=0)


def test_the_folder_holds_a_card_a_configuration_and_weights(saved):
    folder, model = saved
    assert {path.name for path in folder.iterdir()} == {"README.md", CONFIG_NAME, WEIGHTS_NAME}
    content = json.loads((folder / CONFIG_NAME).read_text())
    assert content["network"] == model.config
    assert content["stereokit"]
    assert set(load_file(folder / WEIGHTS_NAME)) == set(model.state_dict())


def test_strings_and_paths_are_folders(saved):
    folder, model = saved
    for given_folder in (folder, str(folder)):
        assert StereoModel.from_pretrained(given_folder).config == model.config


def test_saving_again_replaces(copy):
    other = small_coex(top_k=4)
    other.save_pretrained(copy)
    assert StereoModel.from_pretrained(copy).config == other.config


def test_foreign_blocks_are_refused_and_what_was_there_stays(copy):
    before = {path.name: path.read_bytes() for path in copy.iterdir()}
    model = small_coex(regression=TopKSoftArgmin(3))
    with pytest.raises(
        ConfigError, match=r"the regression of this network was passed in as a module.*register its class"
    ):
        model.save_pretrained(copy)
    assert {path.name: path.read_bytes() for path in copy.iterdir()} == before


def test_a_disk_that_is_full_leaves_what_was_there(copy, monkeypatch):
    before = {path.name: path.read_bytes() for path in copy.iterdir()}

    def full(tensors):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("stereokit.weights.folder.save", full)
    with pytest.raises(InputError, match="No space left"):
        small_coex().save_pretrained(copy)
    assert {path.name: path.read_bytes() for path in copy.iterdir()} == before


def test_the_hub_gets_the_three_files(tmp_path, monkeypatch):
    sent = {}

    class Hub:
        def __init__(self, **_):
            pass

        def create_repo(self, repo_id, **_):
            return SimpleNamespace(repo_id=repo_id)

        def upload_folder(self, *, repo_id, folder_path, **_):
            sent.update({path.name: path.stat().st_size for path in folder_path.iterdir()})
            return f"https://hub/{repo_id}"

    monkeypatch.setattr("huggingface_hub.hub_mixin.HfApi", Hub)
    model = small_coex()
    assert model.save_pretrained(tmp_path / "mine", push_to_hub=True, private=True) == "https://hub/mine"
    assert sent == {path.name: path.stat().st_size for path in (tmp_path / "mine").iterdir()}
    assert model.push_to_hub("owner/name") == "https://hub/owner/name"


def test_networks_made_by_hand_are_refused(tmp_path):
    made = small_coex()
    slots = ("backbone", "cost", "aggregation", "regression", "upsampler")
    blocks = {slot: getattr(made, slot) for slot in slots}
    model = StereoModel(**blocks, max_disparity=32)
    with pytest.raises(ConfigError, match="it has no configuration"):
        model.save_pretrained(tmp_path / "network")
    assert not (tmp_path / "network").exists()


def test_networks_with_a_plugin_say_which_component_is_missing(tmp_path, monkeypatch):
    monkeypatch.setattr(COSTS, "_factories", {**COSTS._factories, "mine": COSTS.get("correlation")})
    small_coex(cost={"name": "mine"}).save_pretrained(tmp_path)
    assert StereoModel.from_pretrained(tmp_path).config["cost"]["name"] == "mine"
    monkeypatch.undo()
    with pytest.raises(ConfigError, match="unknown cost 'mine'"):
        StereoModel.from_pretrained(tmp_path)


@pytest.mark.parametrize("name", [CONFIG_NAME, WEIGHTS_NAME])
def test_missing_files_are_named(copy, name):
    (copy / name).unlink()
    with pytest.raises(CheckpointError, match=name):
        StereoModel.from_pretrained(copy)
    (copy / name).mkdir()
    with pytest.raises(CheckpointError, match=name):
        StereoModel.from_pretrained(copy)


@pytest.mark.parametrize(
    "content",
    [b"", b"null", b"3", b"[1]", b"{}", b'{"network": 5}', b'{"network": "coex"}', b"{", b"\xff\xfe\0", b"[" * 100_000],
    ids=lambda content: repr(content[:20]),
)
def test_damaged_configurations_are_named(copy, content):
    (copy / CONFIG_NAME).write_bytes(content)
    with pytest.raises(CheckpointError, match=CONFIG_NAME) as error:
        StereoModel.from_pretrained(copy)
    assert str(copy) in str(error.value)


@pytest.mark.parametrize(
    "change",
    [
        {"name": None},
        {"name": "coexx"},
        {"cost": 5},
        {"cost": {"name": 5}},
        {"cost": {"name": "correlation", "projection": [1]}},
        {"mean": None},
        {"max_disparity": "32"},
        {"max_disparity": 33},
        {"regression": {"name": "top_k", "k": "2"}},
        {"regression": {"instance": "some.Module"}},
        {"extra": 1},
    ],
)
def test_impossible_configurations_are_refused(copy, change):
    content = json.loads((copy / CONFIG_NAME).read_text())
    content["network"].update(change)
    (copy / CONFIG_NAME).write_text(json.dumps(content))
    with pytest.raises(StereoKitError):
        StereoModel.from_pretrained(copy)


@given(st.data())
@settings(max_examples=25)
def test_truncated_weights_are_refused(saved, tmp_path_factory, data):
    folder = shutil.copytree(saved[0], tmp_path_factory.mktemp("truncated") / "copy")
    weights = folder / WEIGHTS_NAME
    content = weights.read_bytes()
    weights.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    with pytest.raises(CheckpointError, match=WEIGHTS_NAME):
        StereoModel.from_pretrained(folder)


def test_a_pickle_in_place_of_weights_is_not_loaded(copy):
    torch.save({"a": torch.ones(1)}, copy / WEIGHTS_NAME)
    with pytest.raises(CheckpointError, match=WEIGHTS_NAME):
        StereoModel.from_pretrained(copy)


def test_weights_of_another_network_are_refused_by_key(copy):
    state = load_file(copy / WEIGHTS_NAME)
    missing = "cost.projection.layers.1.bias"
    reshaped = "cost.projection.layers.1.weight"
    state["stranger"] = state.pop(missing)
    state[reshaped] = torch.zeros(2, 3)
    save_file(state, copy / WEIGHTS_NAME)
    with pytest.raises(CheckpointError) as error:
        StereoModel.from_pretrained(copy)
    for word in (
        WEIGHTS_NAME,
        f"missing {missing}",
        "unknown stranger",
        f"{reshaped} has shape (2, 3), not (8, 8, 1, 1)",
    ):
        assert word in str(error.value)


def test_weights_that_do_not_fit_change_nothing():
    model = torch.nn.Linear(2, 3)
    before = model.weight.clone()
    with pytest.raises(CheckpointError, match="missing bias"):
        load_state(model, {"weight": torch.ones(3, 2)}, "there")
    assert_close(model.weight, before, rtol=0, atol=0)
    load_state(model, {"weight": torch.ones(3, 2), "bias": torch.ones(3)}, "there")
    assert_close(model.weight, torch.ones(3, 2))


@pytest.fixture
def offline(monkeypatch, tmp_path):
    """No network: the hub's client finds what is in its cache, which is empty."""
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    return {"cache_dir": tmp_path / "cache"}


def test_the_hub_out_of_reach_is_a_plain_error(offline):
    expected = "'somebody/coex' is no folder, and can't be read as a repository of the hub"
    with pytest.raises(CheckpointError, match=expected):
        StereoModel.from_pretrained("somebody/coex", **offline)


@pytest.mark.parametrize("name", ["coez", "./coex", "../coex", "/coex", "runs/mine/network", "runs/", ""])
def test_the_hub_is_not_asked_for_what_is_no_repository(no_hub, tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CheckpointError, match=f"'{re.escape(name)}' is no folder, and no repository of the hub, owner"):
        StereoModel.from_pretrained(name)


@pytest.mark.parametrize("name", ["coez", "PSMNet", "nofolder", "coex.synthetic_v99", "./nofolder"])
def test_unknown_names_of_networks_are_not_asked_for_either(no_hub, name):
    with pytest.raises(
        CheckpointError, match=f"unknown network '{name}', and no file or folder; .*an exported file"
    ) as refusal:
        Predictor(name)
    assert "Known: coex, coex.synthetic_v7" in str(refusal.value)
    assert ("did you mean 'coex" in str(refusal.value)) == name.startswith("coe")


def test_a_repository_of_the_hub_loads(saved, monkeypatch):
    folder, model = saved
    asked = []

    def download(repository, name, **arguments):
        asked.append((repository, name, arguments))
        return str(folder / name)

    monkeypatch.setattr("stereokit.weights.folder.hf_hub_download", download)
    loaded = StereoModel.from_pretrained("somebody/coex", revision="v1")
    assert loaded.config == model.config
    assert asked == [("somebody/coex", name, {"revision": "v1"}) for name in (CONFIG_NAME, WEIGHTS_NAME)]
