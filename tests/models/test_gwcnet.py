import pytest
import torch

from stereokit import build_model, load_published
from tests.golden import published_state, recording, save_checkpoint
from tests.shared import needs_shared


def test_it_becomes_a_cascade_by_a_line():
    candidates = {"name": "neighborhood_range", "planes": 24}
    model = build_model("gwcnet_gc", coarse=[{"stride": 4}], stride=2, candidates=candidates, max_disparity=64)
    # groups keep their size: 40 of 8 channels at stride 4, 4 at stride 2
    assert [stage.cost.out_channels for stage in (model.coarse[0], model)] == [64, 28]
    assert [stage.cost.planes for stage in (model.coarse[0], model)] == [16, 12]
    assert build_model(model.config).config == model.config
    assert len(model(*torch.rand(2, 2, 3, 32, 64)).predictions) == len(model.loss_weights) == 8
    disparity = model.eval()(*torch.rand(2, 1, 3, 50, 70)).disparity
    assert disparity.shape == (1, 50, 70)
    assert ((disparity >= 0) & (disparity <= 64)).all()


@needs_shared
@pytest.mark.slow
@pytest.mark.parametrize("name", ["gwcnet_g", "gwcnet_gc"])
def test_the_first_head_computes_what_the_published_one_did(name, tmp_path):
    path = save_checkpoint(published_state(name, (0.5, 0.75)), tmp_path / "published.ckpt")
    model, recorded = load_published(path), recording(name)
    # all heads, while the norms stay in eval mode
    model.training = model.aggregation.training = True
    with torch.inference_mode():
        first = model(recorded["left"], recorded["right"]).predictions[0].disparity
    expected = recorded["disparity0"]
    assert (first[..., ::2, ::2].reshape(expected.shape) - expected).abs().max() < 0.01
