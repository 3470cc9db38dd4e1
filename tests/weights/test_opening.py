import os
import pickle
import re

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn

from stereokit import CheckpointError, ConfigError, Predictor, build_model, load_weights, open_network
from stereokit.errors import StereoKitError
from stereokit.registry import MODELS, WEIGHTS, list_models
from stereokit.weights import default_weights, list_weights
from stereokit.weights.folder import WEIGHTS_NAME
from stereokit.weights.opening import (
    ExportedFile,
    NetworkPlace,
    find_network,
    load_network,
    set_iterations,
    trained_network,
)
from stereokit.weights.published import convert_published
from tests.golden import published_state, save_checkpoint
from tests.shared import needs_shared


def same_weights(one, other):
    ours, theirs = one.state_dict(), other.state_dict()
    return ours.keys() == theirs.keys() and all(torch.equal(ours[key], theirs[key]) for key in ours)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A saved network that no name stands for."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("saved")
    model = build_model("coex", max_disparity=64).eval()
    model.save_pretrained(folder)
    return folder, model


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_network_stands_for_its_default_weights(here, no_hub):
    assert find_network("coex") == find_network("coex.synthetic_v7") == trained_network("coex")
    opened = open_network("coex")
    assert not opened.training
    assert same_weights(opened, load_weights("coex.synthetic_v7"))
    assert same_weights(open_network("coex.synthetic_v7", network="coex"), opened)


def test_a_network_without_weights_is_an_error_unless_it_may_be_untrained(here, no_hub):
    message = r"there are no weights for 'gcnet'; there are .*use \(--weights\) a saved network"
    for opening in (find_network, open_network, load_network, Predictor, trained_network):
        with pytest.raises(ConfigError, match=message):
            opening("gcnet")
    untrained = open_network("gcnet", bare_name="untrained", network="gcnet")
    assert untrained.config == build_model("gcnet").config
    assert not untrained.training
    assert find_network("gcnet", bare_name="untrained") == NetworkPlace("untrained", "gcnet")
    # random ones in place of the default ones too, while weights stay what they are
    assert not same_weights(open_network("coex", bare_name="untrained"), open_network("coex"))
    assert same_weights(open_network("coex.synthetic_v7", bare_name="untrained"), open_network("coex"))
    with pytest.raises(ConfigError, match="bare_name='random' is unknown; use 'trained' or 'untrained'"):
        open_network("coex", bare_name="random")


def test_the_iterations_of_a_recurrent_network_can_be_set(tmp_path):
    model = open_network("rt_igev", bare_name="untrained", max_disparity=64)
    set_iterations(model, 2)
    assert model.test_iterations == model.config["test_iterations"] == 2
    # and are kept where it is saved
    model.save_pretrained(tmp_path / "saved")
    assert open_network(tmp_path / "saved").test_iterations == 2
    assert same_weights(open_network(tmp_path / "saved"), model)
    with pytest.raises(ConfigError, match="test_iterations=0 has to be a whole number from 1 up"):
        set_iterations(model, 0)
    with pytest.raises(ConfigError, match="StereoModel has no iterations; leave out --iterations"):
        set_iterations(build_model("coex"), 2)


def test_the_iterations_of_an_exported_file_are_its_own(tmp_path):
    (tmp_path / "net.onnx").write_bytes(b"")
    with pytest.raises(ConfigError, match="holds the iterations that it was exported with"):
        set_iterations(open_network(tmp_path / "net.onnx"), 2)


def test_a_saved_network_opens_from_its_folder(saved, no_hub):
    folder, model = saved
    for place in (folder, str(folder), find_network(folder)):
        opened = open_network(place, network="coex")
        assert same_weights(opened, model)
        assert opened.config == model.config
        assert not opened.training
    assert same_weights(Predictor(folder, "cpu").model, model)


def test_what_lies_on_disk_goes_before_every_name(saved, here, no_hub):
    folder, _ = saved
    for name in ("coex", "coex.synthetic_v7", "owner/name", "gcnet", "net.onnx"):
        (here / name).parent.mkdir(exist_ok=True)
        (here / name).symlink_to(folder)
        assert find_network(name) == NetworkPlace("folder", name)
    assert open_network("net.onnx").max_disparity == 64
    # what was found before is not looked for again
    assert same_weights(open_network(trained_network("coex")), load_weights("coex.synthetic_v7"))


def test_the_hub_is_asked_for_what_is_nowhere_else(saved, here, monkeypatch):
    folder, model = saved
    asked = []

    def download(repository, name, **arguments):
        asked.append(repository)
        return str(folder / name)

    monkeypatch.setattr("stereokit.weights.folder.hf_hub_download", download)
    assert find_network("owner/name") == NetworkPlace("hub", "owner/name")
    assert not asked
    assert same_weights(open_network("owner/name", network="coex"), model)
    assert set(asked) == {"owner/name"}


def test_overrides_change_the_network_around_its_weights(saved, here, monkeypatch):
    folder, model = saved
    monkeypatch.setattr("stereokit.weights.folder.hf_hub_download", lambda repository, name: str(folder / name))
    for place in (folder, "owner/name"):
        opened = open_network(place, max_disparity=96, top_k=3)
        assert (opened.max_disparity, opened.config["regression"]["k"]) == (96, 3)
        assert same_weights(opened, model)
    assert open_network("coex", max_disparity=96).max_disparity == 96
    assert open_network("gcnet", bare_name="untrained", max_disparity=96).max_disparity == 96
    for place in (folder, "coex"):
        with pytest.raises(CheckpointError, match="it differs in guidance; leave that as it is, or train it"):
            open_network(place, guidance="none")
        with pytest.raises(ConfigError, match="takes no argument 'max_disprity'; did you mean 'max_disparity'"):
            open_network(place, max_disprity=96)


def test_the_network_has_to_be_the_one_that_was_asked_for(saved, here):
    for place in (saved[0], "coex", "coex.synthetic_v7"):
        with pytest.raises(CheckpointError, match=r"holds a coex, not a psmnet; use network='coex' \(--model coex\)"):
            open_network(place, network="psmnet")
    with pytest.raises(CheckpointError, match="'gcnet' holds a gcnet, not a coex"):
        open_network("gcnet", network="coex", bare_name="untrained")


@needs_shared
@pytest.mark.parametrize(("state", "network"), [("coex", "coex"), ("psmnet_corr", "psmnet")])
def test_a_published_checkpoint_tells_its_network(tmp_path, state, network):
    path = save_checkpoint(published_state(state), tmp_path / "published.ckpt")
    assert find_network(path).kind == "published"
    opened = open_network(path, max_disparity=64)
    assert opened.config["name"] == network
    assert opened.max_disparity == 64
    assert not opened.training
    named, report = convert_published(path, network, "bgr", max_disparity=64)
    assert same_weights(named, opened)
    assert report.loaded == len(opened.state_dict())
    assert not same_weights(open_network(path, channel_order="rgb", max_disparity=64), opened)
    assert Predictor(path, "cpu").model.config["name"] == network
    other = {"coex": "psmnet", "psmnet": "coex"}[network]
    with pytest.raises(CheckpointError, match=f"is no published {other}.*--model {network}"):
        open_network(path, network=other)
    with pytest.raises(ConfigError, match="no published format is known for network 'gcnet'"):
        open_network(path, network="gcnet")


def test_a_file_that_is_no_published_checkpoint_is_refused_once(here):
    (here / "text.ckpt").write_text("no checkpoint")
    with pytest.raises(CheckpointError) as refusal:
        open_network("text.ckpt")
    assert str(refusal.value).count("text.ckpt") == 1
    torch.save({"weight": torch.zeros(1)}, "other.pth")
    with pytest.raises(CheckpointError, match="of no network whose published keys are known"):
        open_network("other.pth")


def test_an_exported_file_is_left_to_a_backend(here, no_hub):
    for name in ("net.onnx", "NET.XML"):
        with pytest.raises(CheckpointError, match=f"the exported file '{name}' does not exist"):
            open_network(name)
        (here / name).touch()
        opened = open_network(here / name)
        assert opened == ExportedFile(str(here / name))
        assert os.fspath(opened) == opened.path
        with pytest.raises(CheckpointError, match=f"{name}' is an exported file, .* use the network that it was exp"):
            load_network(name)
        for arguments, named in (
            ({"network": "coex"}, r"network \(--model\)"),
            ({"channel_order": "rgb"}, r"channel_order \(--channel-order\)"),
            ({"top_k": 3, "max_disparity": 64}, r"top_k \(--top-k\) and max_disparity \(--max-disparity\)"),
        ):
            with pytest.raises(ConfigError, match=f"is used as it was exported; leave out {named}"):
                open_network(name, **arguments)


def test_files_that_hold_something_else_are_refused(saved, here):
    (here / "network.pt2").touch()
    with pytest.raises(CheckpointError, match=r"which torch\.export\.load reads"):
        find_network("network.pt2")
    with pytest.raises(CheckpointError, match="holds weights alone; use the folder"):
        find_network(saved[0] / WEIGHTS_NAME)
    (here / "empty").mkdir()
    with pytest.raises(CheckpointError, match=r"'empty' holds no saved network: config\.json is not there"):
        open_network("empty")
    for nothing in (None, 3, nn.Identity()):
        with pytest.raises(ConfigError, match=f"by its name or path; got {type(nothing).__name__}"):
            open_network(nothing)


def test_the_channel_order_is_for_published_checkpoints(saved, here):
    for place, kind in ((saved[0], "the folder of a saved network"), ("coex.synthetic_v7", "the name of weights")):
        with pytest.raises(ConfigError, match=rf"is {kind}, and channel_order .* only be given for published"):
            open_network(place, channel_order="bgr")
    published = NetworkPlace("published", "x.ckpt")
    published.check_published_options(channel_order="rgb", top_k=3)
    NetworkPlace("hub", "owner/name").check_published_options(channel_order=None, top_k=None)


def test_places_know_their_files_and_travel_to_other_processes(saved, here):
    folder, _ = saved
    assert find_network(folder).file() == folder / WEIGHTS_NAME
    assert find_network("coex").file().is_file()
    assert NetworkPlace("hub", "owner/name").file() is None
    assert find_network("gcnet", bare_name="untrained").file() is None
    (here / "net.onnx").touch()
    assert find_network("net.onnx").file().name == "net.onnx"
    assert pickle.loads(pickle.dumps(find_network("coex"))) == find_network("coex")


def test_every_name_that_the_library_knows_opens():
    for name in list_weights():
        assert find_network(name) == NetworkPlace("weights", name)
    for name in list_models():
        assert find_network(name, bare_name="untrained") == NetworkPlace("untrained", name)


@pytest.mark.parametrize("bare_name", ["trained", "untrained"])
@given(name=st.text("ceox.nptsm_v7/ .-ü\n", max_size=12))
def test_any_text_is_found_or_refused_in_a_line_that_names_it(bare_name, name):
    refusal = None
    try:
        place = find_network(name, bare_name=bare_name)
    except StereoKitError as error:
        refusal = str(error)
    if refusal is not None:
        assert repr(name) in refusal
        assert "\n" not in refusal
        assert "use" in refusal
    elif place.kind == "hub":
        assert re.fullmatch(r"[^/ ]+/[^/ ]+", name)
    elif place.kind == "folder":
        assert os.path.isdir(name)
    else:
        assert place.name == name or place.name == default_weights(name)
        assert name in (MODELS if name in MODELS else WEIGHTS)
