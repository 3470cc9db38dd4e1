"""What a network without slots can do as others can, and what is DispNetC's own."""

import pytest
import torch
from torch.testing import assert_close

from stereokit import ConfigError, StereoNetwork, build_model
from stereokit.cli import main
from stereokit.models.dispnetc import BOTTOM, SKIPS, Decoder, _positive

RECIPE = """
about = "A run of seconds."

[model]
name = "dispnetc"
max_disparity = 32

[scenes]
size = [64, 64]
max_disparity = 16
count = 4

[augmentation]
crop_height = 64
crop_width = 64

[schedule]
batch = 1
steps = 2

[optimisation]
learning_rate = 1e-4

[loss]
kind = "l1"
"""


def test_a_negated_decoder_predicts_the_negative():
    """The table of signs, on any weights."""
    torch.manual_seed(0)
    decoder = Decoder().double()
    state = {f"decoder.{key}": value for key, value in decoder.state_dict().items()}
    skips = [torch.randn(1, c, 2**n, 2**n, dtype=torch.float64) for c, n in zip(SKIPS, (5, 4, 3, 2, 1), strict=True)]
    bottom = torch.randn(1, BOTTOM, 1, 1, dtype=torch.float64)
    with torch.no_grad():
        before = decoder(skips, bottom)
        turned = _positive({key: -value if ".predict." in key else value for key, value in state.items()})
        decoder.load_state_dict({key.removeprefix("decoder."): value for key, value in turned.items()})
        after = decoder(skips, bottom)
    for one, other in zip(before, after, strict=True):
        assert_close(one, -other)
        assert one.abs().max() > 0


def test_predictions_go_from_coarse_to_fine():
    model = build_model("dispnetc", max_disparity=32)
    output = model(*torch.rand(2, 1, 3, 64, 128))
    assert [p.stride for p in output.predictions] == [64, 32, 16, 8, 4, 2]
    assert [tuple(p.disparity.shape) for p in output.predictions[:2]] == [(1, 1, 2), (1, 2, 4)]
    assert model.auxiliary_weights == (0.2,) * 5


def test_disparity_is_never_negative_and_has_no_confidence():
    model = build_model("dispnetc", max_disparity=32).eval()
    torch.nn.init.constant_(model.decoder.levels[0].predict.bias, -100.0)
    with torch.inference_mode():
        output = model(*torch.rand(2, 1, 3, 64, 64))
    assert (output.disparity == 0).all()
    assert output.confidence is None


@pytest.mark.parametrize("max_disparity", [0, -4, 30, 32.0, True])
def test_the_reach_is_a_multiple_of_four(max_disparity):
    with pytest.raises(ConfigError, match="max_disparity"):
        build_model("dispnetc", max_disparity=max_disparity)


def test_it_is_described(capsys):
    assert main(["info", "dispnetc", "--size", "64", "128"]) == 0
    said = capsys.readouterr().out
    assert said.startswith("dispnetc: max_disparity 160, one pair of 128 x 64 px\n")
    for block in ("features", "correlation", "encoder", "decoder"):
        assert f"\n{block}" in said
    assert "42,429,110" in said


def test_its_time_is_split_into_its_blocks(capsys):
    options = ["--size", "64", "64", "--repeats", "1", "--warmup", "1", "--stages", "--max-disparity", "32"]
    assert main(["bench", "dispnetc", *options]) == 0
    said = capsys.readouterr().out
    for block in ("features", "correlation", "encoder", "decoder"):
        assert block in said


@pytest.mark.slow
def test_it_is_trained_by_a_recipe(tmp_path, monkeypatch):
    monkeypatch.setattr("stereokit.training.opening.VALIDATION_SCENES", 1)
    recipe = tmp_path / "mine.toml"
    recipe.write_text(RECIPE)
    assert (
        main(
            ["train", "--recipe", str(recipe), "--out", str(tmp_path / "run"), "--workers", "0", "--accelerator", "cpu"]
        )
        == 0
    )
    trained = StereoNetwork.from_pretrained(tmp_path / "run" / "network")
    assert trained.config["name"] == "dispnetc"
    assert trained.max_disparity == 32
