import json
import shutil

import pytest
import torch
from safetensors.torch import load_file

from stereokit.builder import build_model
from stereokit.data.synthetic import SyntheticScenes
from stereokit.errors import CheckpointError, ConfigError
from stereokit.inference import Predictor
from stereokit.metrics import end_point_error
from stereokit.model import StereoModel
from stereokit.registry import WEIGHTS
from stereokit.runtime.provenance import file_sha256, state_sha256
from stereokit.weights import (
    DEFAULTS,
    default_weights,
    list_weights,
    load_weights,
    read_manifest,
    weights_folder,
)
from stereokit.weights.release import main, release

OURS = [name for name in list_weights() if weights_folder(name).parent.name == "weights"]


def holds(config, older):
    """Whether a configuration says all that an older one does, down to the arguments of its blocks."""
    if isinstance(older, dict):
        return all(key in config and holds(config[key], value) for key, value in older.items())
    return config == older


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    """Released weights of a network that nobody trained."""
    root = tmp_path_factory.mktemp("mine")
    torch.manual_seed(0)
    build_model("coex", max_disparity=64, top_k=3).save_pretrained(root / "network")
    (root / "network" / "training.json").write_text(json.dumps({"recipe": {"name": "none"}, "seed": 0}))
    release(root / "network", "coex.mine", root / "coex.mine", results={"bad_3": 99.0})
    return root


@pytest.fixture
def registered(mine, tmp_path):
    """The same, at hand by name, in a folder to damage."""
    folder = tmp_path / "coex.mine"
    shutil.copytree(mine / "coex.mine", folder)
    WEIGHTS.register("coex.mine")(lambda: folder)
    yield folder
    del WEIGHTS._factories["coex.mine"]


@pytest.mark.parametrize("name", OURS)
def test_what_ships_is_whole_small_and_says_where_it_is_from(name):
    manifest, file = read_manifest(name), weights_folder(name) / "model.safetensors"
    assert manifest["name"] == name
    assert file_sha256(file) == manifest["sha256"]
    assert file.stat().st_size < 6e6
    assert manifest["licence"] == "Apache-2.0"
    assert manifest["training"]["data"] == []
    assert all(len(digest) == 64 for digest in (manifest["training"]["textures"] or {}).values())
    assert {"recipe", "seed", "commit", "steps", "pairs_seen", "command"} <= manifest["training"].keys()
    assert "command" in manifest["results"]
    # what later versions can do besides is left at its default
    assert holds(build_model(manifest["network"]).config, manifest["network"])
    assert load_weights(name).config["name"] == name.partition(".")[0]


@pytest.mark.parametrize(("network", "name"), DEFAULTS.items())
def test_the_usual_weights_know_what_they_do(network, name):
    scenes = SyntheticScenes(seed=77, size=(128, 256), max_disparity=48, count=4)
    predict = Predictor(network, device="cpu")
    errors, of_a_constant = [], []
    for index in range(4):
        truth = torch.from_numpy(scenes[index].disparity)
        disparity = torch.from_numpy(predict(scenes[index].left, scenes[index].right).disparity)
        errors.append(float(end_point_error(disparity, truth)))
        of_a_constant.append(float(end_point_error(truth.median().expand_as(truth), truth)))
    assert sum(errors) < 0.7 * sum(of_a_constant)
    assert default_weights(network) == name


def test_every_way_to_the_weights_leads_to_the_same(registered, mine):
    expected = {key: value.half() for key, value in StereoModel.from_pretrained(mine / "network").state_dict().items()}
    ways = [
        build_model("coex.mine"),
        build_model("coex", pretrained="mine"),
        load_weights("coex.mine"),
        load_weights(registered),
        Predictor("coex.mine", device="cpu").model,
        Predictor(registered, device="cpu").model,
    ]
    for model in ways:
        assert not model.training
        assert model.config["max_disparity"] == 64
        for key, value in model.state_dict().items():
            assert torch.equal(value, expected[key].to(value.dtype))
    assert "coex.mine" in list_weights("coex.*")


def test_what_lies_on_disk_goes_before_the_name(registered, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    build_model("coex", max_disparity=96).save_pretrained("coex.own")
    monkeypatch.setitem(WEIGHTS._factories, "coex.own", lambda: registered)
    assert Predictor("coex.own", device="cpu").model.config["max_disparity"] == 96


def test_overrides_that_fit_and_overrides_that_do_not(registered):
    assert build_model("coex", pretrained="mine", top_k=2, max_disparity=128).config["max_disparity"] == 128
    with pytest.raises(CheckpointError, match="it differs in guidance; leave that as it is, or train it"):
        build_model("coex", pretrained="mine", guidance="none")


def test_weights_that_there_are_not(registered):
    with pytest.raises(ConfigError, match=r"unknown weights 'coex\.mime'; did you mean 'coex\.mine'"):
        build_model("coex", pretrained="mime")
    with pytest.raises(ConfigError, match=r"unknown weights 'coex\.mime'; did you mean 'coex\.mine'"):
        build_model("coex.mime")
    with pytest.raises(ConfigError, match="no weights for 'gcnet'"):
        build_model("gcnet", pretrained=True)
    with pytest.raises(ConfigError, match="unknown model 'coexx'"):
        build_model("coexx", pretrained=True)
    with pytest.raises(ConfigError, match="belong to a network's name"):
        build_model(build_model("coex").config, pretrained=True)


def test_several_weights_without_a_usual_one(registered, monkeypatch):
    monkeypatch.setitem(WEIGHTS._factories, "psmnet.a", lambda: registered)
    assert default_weights("psmnet") == "psmnet.a"
    monkeypatch.setitem(WEIGHTS._factories, "psmnet.b", lambda: registered)
    with pytest.raises(ConfigError, match=r"name one of psmnet\.a, psmnet\.b"):
        default_weights("psmnet")


def test_damage_is_noticed(registered):
    weights, manifest = registered / "model.safetensors", registered / "manifest.json"
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"are damaged: their SHA-256 is .* get them again"):
        load_weights("coex.mine")
    weights.unlink()
    with pytest.raises(CheckpointError, match="can't be read"):
        load_weights("coex.mine")
    manifest.write_text("{}")
    with pytest.raises(CheckpointError, match="lacks name, sha256"):
        load_weights("coex.mine")
    manifest.write_text("{")
    with pytest.raises(CheckpointError, match=r"manifest.json' can't be read"):
        load_weights("coex.mine")


def test_a_release_holds_halves_and_the_record(mine, tmp_path):
    state = load_file(mine / "coex.mine" / "model.safetensors")
    assert {value.dtype for value in state.values()} == {torch.float16, torch.int64}
    manifest = json.loads((mine / "coex.mine" / "manifest.json").read_text())
    assert manifest["training"] == {"recipe": {"name": "none"}, "seed": 0}
    assert manifest["results"] == {"bad_3": 99.0}
    assert manifest["precision"] == "float16"
    again = release(mine / "network", "coex.again", tmp_path / "again", results={}, command="stereokit train")
    assert again["training"] == {**manifest["training"], "command": "stereokit train"}


def test_a_release_tells_what_its_training_began_with(registered, tmp_path):
    start = load_weights("coex.mine")
    start.save_pretrained(tmp_path / "network")
    record = tmp_path / "network" / "training.json"
    record.write_text(json.dumps({"seed": 1, "start": state_sha256(start.state_dict())}))
    training = release(tmp_path / "network", "coex.next", tmp_path / "next", results={})["training"]
    before = read_manifest("coex.mine")
    assert training["started_from"] == {
        "name": "coex.mine",
        "sha256": before["sha256"],
        "training": before["training"],
    }
    record.write_text(json.dumps({"seed": 1, "start": "0" * 64}))
    with pytest.raises(ConfigError, match=r"not at hand \(SHA-256 of their tensors: 000"):
        release(tmp_path / "network", "coex.other", tmp_path / "other", results={})


@pytest.mark.slow
def test_a_release_may_be_the_mean_with_other_weights(registered, tmp_path):
    torch.manual_seed(1)
    network = build_model("coex", max_disparity=64, top_k=3)
    network.save_pretrained(tmp_path / "network")
    (tmp_path / "network" / "training.json").write_text(json.dumps({"seed": 1}))
    third = build_model("coex", max_disparity=64, top_k=3)
    third.save_pretrained(tmp_path / "third")
    (tmp_path / "third" / "training.json").write_text(json.dumps({"seed": 2}))
    release(tmp_path / "third", "coex.third", folder := tmp_path / "coex.third", results={})
    arguments = [tmp_path / "network", "coex.mean", "--out", tmp_path / "mean", "--results", tmp_path / "results.json"]
    (tmp_path / "results.json").write_text("{}")
    assert main([*map(str, arguments), "--mean-with", "coex.mine", "--mean-with", str(folder)]) == 0
    assert read_manifest(tmp_path / "mean")["training"]["mean_with"] == [
        {"name": "coex.mine", "sha256": read_manifest("coex.mine")["sha256"]},
        {"name": "coex.third", "sha256": read_manifest(folder)["sha256"], "training": {"seed": 2}},
    ]
    mean, *others = (load_weights(place).state_dict() for place in (tmp_path / "mean", "coex.mine", folder))
    for key, value in network.state_dict().items():
        if value.is_floating_point():
            expected = (value + others[0][key] + others[1][key]) / 3
            torch.testing.assert_close(mean[key], expected, rtol=1e-3, atol=1e-5)
    build_model("coex", max_disparity=32, top_k=3).save_pretrained(tmp_path / "network")
    with pytest.raises(ConfigError, match=r"'coex\.mine' are not of the same network"):
        release(tmp_path / "network", "coex.mean", tmp_path / "other", results={}, mean_with=["coex.mine"])


@pytest.mark.slow
def test_a_training_may_have_begun_with_a_release_that_has_no_name_here(tmp_path):
    torch.manual_seed(2)
    first, second = (build_model("coex", max_disparity=64) for _ in range(2))
    before, after = tmp_path / "before", tmp_path / "after"
    first.save_pretrained(before / "network")
    started = state_sha256(first.state_dict())
    (before / "network" / "training.json").write_text(json.dumps({"seed": 1, "weights_sha256": started}))
    release(before / "network", "coex.before", before / "released", results={})
    second.save_pretrained(after / "network")
    ended = state_sha256(second.state_dict())
    record = after / "network" / "training.json"
    record.write_text(json.dumps({"seed": 2, "start": started, "weights_sha256": ended}))
    with pytest.raises(ConfigError, match="not at hand"):
        release(after / "network", "coex.after", after / "alone", results={})
    (tmp_path / "results.json").write_text("{}")
    arguments = [after / "network", "coex.after", "--out", after / "mean", "--results", tmp_path / "results.json"]
    arguments += ["--started-from", before / "released", "--mean-with", before / "released"]
    assert main(list(map(str, arguments))) == 0
    manifest = read_manifest(after / "mean")
    known = {"name": "coex.before", "sha256": read_manifest(before / "released")["sha256"]}
    assert manifest["training"]["mean_with"] == [known]
    assert manifest["training"]["started_from"] == {**known, "training": {"seed": 1, "weights_sha256": started}}
    # a mean is not what its last training came to
    record.write_text(json.dumps({"seed": 3, "start": ended}))
    with pytest.raises(ConfigError, match="not at hand"):
        release(after / "network", "coex.next", after / "next", results={}, started_from=after / "mean")


def test_releases_that_can_not_be(mine, tmp_path, capsys):
    with pytest.raises(ConfigError, match=r"named coex\.TAG, not 'psmnet.mine'"):
        release(mine / "network", "psmnet.mine", tmp_path / "a", results={})
    results = tmp_path / "results.json"
    results.write_text("{}")
    arguments = [str(mine / "network"), "coex.new", "--out", str(tmp_path / "new"), "--results", str(results)]
    assert main(arguments) == 0
    assert "sha256" in capsys.readouterr().out
    assert main(arguments) == 2
    assert "exists already" in capsys.readouterr().err
    large = build_model("coex", max_disparity=64)
    with torch.no_grad():
        next(large.parameters()).fill_(1e6)
    large.save_pretrained(tmp_path / "large")
    with pytest.raises(CheckpointError, match="the record of the training"):
        release(tmp_path / "large", "coex.large", tmp_path / "b", results={})
    (tmp_path / "large" / "training.json").write_text("{}")
    with pytest.raises(ConfigError, match="float16 can't hold backbone"):
        release(tmp_path / "large", "coex.large", tmp_path / "b", results={})
