import pytest
import torch
from torch.testing import assert_close

from stereokit import ConfigError, build_model, load_published
from stereokit.backends import open_backend
from stereokit.export import export_onnx
from tests.golden import published_state, recording, save_checkpoint
from tests.models.cases import CASES
from tests.optimize.networks import with_statistics
from tests.shared import needs_shared


@needs_shared
@pytest.mark.slow
@pytest.mark.parametrize("name", ["fast_acvnet", "fast_acvnet_plus"])
def test_the_supervised_disparities_are_the_published_ones(name, tmp_path):
    golden, recorded = CASES[name].golden, recording(name)
    path = save_checkpoint(published_state(name, golden.norm, seed=golden.seed), tmp_path / "published.ckpt")
    model = load_published(path, name, "rgb")
    # training mode, with norms in eval mode
    model.training = True
    with torch.inference_mode():
        attention, _, coarse, fine = model(recorded["left"], recorded["right"]).predictions
    for prediction, of in ((attention, "disparity_attention_4"), (coarse, "disparity_4"), (fine, "disparity")):
        assert_close(prediction.disparity, recorded[of], rtol=0, atol=0.01)


@pytest.mark.slow
def test_a_file_chooses_the_same_candidates(tmp_path):
    images = torch.rand(2, 1, 3, 64, 96).unbind()
    model = with_statistics(build_model("fast_acvnet_plus", max_disparity=128), images)
    with torch.no_grad():
        # sure, as after training: where levels tie for the last place, rounding decides
        model.attention.aggregation.up1.weight *= 100
    report = export_onnx(model, tmp_path / "network.onnx", size=(64, 96))
    with torch.inference_mode():
        apart = (open_backend(report.path, "cpu")(*images).disparity - model(*images).disparity).abs()
    assert (apart < 0.01).float().mean() > 0.98


def test_the_range_and_the_candidates_are_multiples():
    for wrong in ({"max_disparity": 112}, {"candidates": 6}, {"candidates": 0}):
        with pytest.raises(ConfigError, match="multiple"):
            build_model("fast_acvnet", **wrong)


def test_small_ranges_keep_all_levels():
    assert build_model("fast_acvnet_plus", max_disparity=64).candidates == 16


def test_a_sure_attention_leaves_no_other_disparity():
    model = build_model("fast_acvnet_plus", max_disparity=128, candidates=4).eval()

    def sure(_module, inputs, output):
        logits = torch.zeros_like(output)
        logits[:, 8:12] = 50.0
        return logits

    model.attention.register_forward_hook(sure)
    with torch.inference_mode():
        disparity = model(*torch.rand(2, 1, 3, 64, 96)).disparity
    assert ((disparity >= 32 - 1e-3) & (disparity <= 44 + 1e-3)).all()
