import logging
import pickle
from pathlib import Path

import pytest
import torch
from torch import Tensor

from stereokit import CheckpointError, ConfigError, build_model, load_published
from stereokit.config import IMAGENET_MEAN, IMAGENET_STD
from stereokit.model import StereoModel
from stereokit.weights.published import convert_published
from tests.golden import GOLDEN, published_state, recording, save_checkpoint
from tests.shared import needs_shared

pytestmark = needs_shared

PSMNET_NORM = (0.3, 0.5)
ZEROS = {"upsampler": {"padding": "zeros"}}


@pytest.fixture(scope="module")
def coex_state() -> dict[str, Tensor]:
    return published_state("coex")


@pytest.fixture(scope="module")
def coex_path(coex_state: dict[str, Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_checkpoint(coex_state, tmp_path_factory.mktemp("coex") / "coex.ckpt")


def close(value: Tensor, recorded: Tensor) -> None:
    """Within 1e-4 of the spread, as the recordings ask."""
    assert value.shape == recorded.shape
    assert (value - recorded).abs().max() < 1e-4 * recorded.std()


def test_coex_computes_what_the_published_one_did(coex_path: Path) -> None:
    golden = recording("coex")
    model = load_published(coex_path, channel_order="rgb", **ZEROS)
    captured = {}
    model.cost.register_forward_hook(lambda _module, _inputs, volume: captured.update(volume=volume))
    model.upsampler.register_forward_hook(
        lambda module, inputs, _output: captured.update(superpixel=module.weights(inputs[1]))
    )
    with torch.inference_mode():
        output = model(golden["left"], golden["right"], return_logits=True)
    close(captured["volume"], golden["correlation"])
    close(output.logits.unsqueeze(1), golden["aggregated"])
    close(captured["superpixel"], golden["superpixel"])
    assert ((output.disparity - golden["disparity"]).abs() < 1e-2).float().mean() > 0.999


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "k"),
    [("psmnet_concat", 192), ("psmnet_concat_gce_k6", 6), ("psmnet_corr", 192), ("psmnet_corr_gce_k6", 6)],
)
def test_psmnet_computes_what_the_published_one_did(name: str, k: int, tmp_path: Path) -> None:
    golden = recording(name)
    path = save_checkpoint(published_state(name, PSMNET_NORM), tmp_path / "psmnet.ckpt")
    model = load_published(path, "psmnet", "rgb", top_k=k)
    assert model.config["cost"]["name"] == ("correlation" if "corr" in name else "concatenation")
    assert model.config["guidance"]["name"] == ("gce" if "gce" in name else "none")
    captured = {}
    model.aggregation.head3.register_forward_hook(lambda _module, _inputs, logits: captured.update(head3=logits))
    with torch.inference_mode():
        output = model(golden["left"], golden["right"], return_logits=True)
        distribution = model.upsampler(output.logits, {})
    close(captured["head3"][..., ::4, ::4], golden["head3"])
    # Where the k-th and the next logit tie to within rounding, which one is kept is chance: a network differs there
    # from itself on another number of threads.
    decided = torch.ones_like(output.disparity, dtype=torch.bool)
    if k < 192:
        best = distribution.topk(k + 1, dim=1).values
        decided = best[:, k - 1] - best[:, k] > 2e-6
        assert decided.float().mean() > 0.9
    agrees = (output.disparity - golden["disparity"][:, 0]).abs() < 1e-2
    assert agrees[decided].float().mean() > 0.999
    assert agrees.float().mean() > 0.99


def test_unused_weights_are_dropped_by_name(coex_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    model, report = convert_published(coex_path)
    assert sum(p.numel() for p in model.parameters()) == 2_721_993
    state = torch.load(coex_path, weights_only=True)["state_dict"]
    floating = [k for k in report.dropped if "num_batches" not in k and "running" not in k]
    assert sum(state[f"stereo.{key}"].numel() for key in floating) == 5_034
    with caplog.at_level(logging.INFO, logger="stereokit"):
        load_published(coex_path)
    assert "cost_agg.conv_up.0.bn.weight" in caplog.text


def test_bgr_weights_see_rgb_images(coex_path: Path) -> None:
    golden = recording("coex")
    rgb = load_published(coex_path, channel_order="rgb", **ZEROS)
    bgr = load_published(coex_path, channel_order="bgr", **ZEROS)
    assert bgr.config["mean"] == list(IMAGENET_MEAN)[::-1]
    assert bgr.config["std"] == list(IMAGENET_STD)[::-1]
    with torch.inference_mode():
        # the weights' red channel is given what they take for red, in whatever place it stands
        expected = rgb(golden["left"], golden["right"]).disparity
        turned = bgr(golden["left"].flip(1), golden["right"].flip(1)).disparity
        unturned = bgr(golden["left"], golden["right"]).disparity
    assert (turned - expected).abs().median() < 1e-3
    assert (unturned - expected).abs().max() > 1


def test_a_bare_state_dict_loads_as_well(coex_state: dict[str, Tensor], coex_path: Path, tmp_path: Path) -> None:
    torch.save(coex_state, tmp_path / "bare.pth")
    bare, lightning = load_published(tmp_path / "bare.pth").state_dict(), load_published(coex_path).state_dict()
    assert all(torch.equal(bare[key], lightning[key]) for key in lightning)


@pytest.mark.parametrize(
    ("guidance", "places", "removed"),
    [("none", "full", "cost_agg.channelAtt"), ("gce", "one", ("cost_agg.channelAtt.", "cost_agg.channelAttDown"))],
)
def test_the_guidance_is_read_off_the_keys(
    coex_state: dict[str, Tensor], tmp_path: Path, guidance: str, places: str, removed: str | tuple[str, ...]
) -> None:
    state = {k: v for k, v in coex_state.items() if not k.startswith(removed)}
    config = load_published(save_checkpoint(state, tmp_path / "x.ckpt")).config
    assert (config["guidance"]["name"], config["guidance_at"]) == (guidance, places)


def test_concatenation_is_read_off_the_keys(coex_state: dict[str, Tensor], tmp_path: Path) -> None:
    state = {
        **coex_state,
        "cost_volume.desc.weight": torch.zeros(24, 48, 1, 1),
        "cost_volume.desc.bias": torch.zeros(24),
        "cost_agg.conv_stem.conv.weight": torch.zeros(8, 48, 3, 3, 3),
    }
    assert load_published(save_checkpoint(state, tmp_path / "x.ckpt")).config["cost"]["name"] == "concatenation"


def test_overrides_decide_what_weights_cannot_tell(coex_path: Path) -> None:
    assert load_published(coex_path, top_k=5).config["regression"]["k"] == 5


def test_missing_and_unknown_keys_are_named(coex_state: dict[str, Tensor], tmp_path: Path) -> None:
    state = {key: value for key, value in coex_state.items() if key != "spx.0.bias"}
    with pytest.raises(CheckpointError, match=r"missing upsampler\.head\.bias"):
        load_published(save_checkpoint(state, tmp_path / "x.ckpt"))
    state = {**coex_state, "novel.weight": torch.zeros(1)}
    with pytest.raises(CheckpointError, match=r"nearest comes coex .* no place for 'novel.weight'"):
        load_published(save_checkpoint(state, tmp_path / "x.ckpt"))


def test_another_network_is_recognised(coex_path: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="network='coex'"):
        load_published(coex_path, "psmnet")
    torch.save({"a.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(CheckpointError, match=r"of no network whose published keys are known .* keys begin 'a.weight'"):
        load_published(tmp_path / "other.pth")


def test_truncated_missing_and_foreign_files_are_refused(coex_path: Path, tmp_path: Path) -> None:
    data = coex_path.read_bytes()
    for size in (0, 3, 10, len(data) // 2, len(data) - 1):
        (tmp_path / "cut.ckpt").write_bytes(data[:size])
        with pytest.raises(CheckpointError, match=r"cut\.ckpt"):
            load_published(tmp_path / "cut.ckpt")
    with pytest.raises(CheckpointError, match="does not exist"):
        load_published(tmp_path / "absent.ckpt")
    torch.save([1, 2], tmp_path / "list.ckpt")
    with pytest.raises(CheckpointError, match="no state dict"):
        load_published(tmp_path / "list.ckpt")


class Evil:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (Path.touch, (Path("ran"),))


def test_a_pickle_that_would_run_code_is_never_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"state_dict": {"stereo.x": Evil()}}, "evil.ckpt")
    Path("plain.pkl").write_bytes(pickle.dumps(Evil()))
    for name in ("evil.ckpt", "plain.pkl"):
        with pytest.raises(CheckpointError, match="run code") as refusal:
            load_published(name)
        # torch's own message tells how to switch the protection off
        assert "weights_only" not in str(refusal.value)
    assert not Path("ran").exists()


def test_unknown_network_and_channel_order(coex_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'coex'"):
        load_published(coex_path, "coexx")
    with pytest.raises(ConfigError, match="'bgr' or 'rgb'"):
        load_published(coex_path, "coex", "grb")  # type: ignore[arg-type]


def test_a_converted_checkpoint_is_saved_and_read_back(coex_path: Path, tmp_path: Path) -> None:
    model = load_published(coex_path, channel_order="bgr")
    model.save_pretrained(tmp_path / "saved")
    again = StereoModel.from_pretrained(tmp_path / "saved")
    assert again.config == model.config
    image = torch.rand(1, 3, 64, 96)
    with torch.inference_mode():
        assert torch.equal(model(image, image).disparity, again(image, image).disparity)


def test_the_pilot_has_the_structure_of_coex() -> None:
    pilot = load_published(GOLDEN / "coex_pilot.ckpt", channel_order="rgb")
    assert pilot.state_dict().keys() == build_model("coex").state_dict().keys()
