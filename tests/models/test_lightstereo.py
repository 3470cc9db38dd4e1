import pytest
import torch
from torch.testing import assert_close

from stereokit import build_model, load_published
from tests.golden import published_state, save_checkpoint
from tests.shared import needs_shared


@needs_shared
@pytest.mark.slow
def test_a_neck_inside_the_backbone_is_found(tmp_path):
    state = published_state("lightstereo_s", (0.5, 0.75))
    moved = {key.replace("neck.", "backbone."): value for key, value in state.items()}
    models = [load_published(save_checkpoint(keys, tmp_path / f"{i}.ckpt")) for i, keys in enumerate((state, moved))]
    for key, value in models[0].state_dict().items():
        assert_close(models[1].state_dict()[key], value, rtol=0, atol=0)


def test_the_logits_are_never_negative_and_the_coarse_disparity_is_supervised():
    model = build_model("lightstereo_s", max_disparity=64).train()
    predictions = model(*torch.rand(2, 2, 3, 64, 96)).predictions
    assert [p.stride for p in predictions] == [4, 1]
    assert (predictions[-1].distribution.logits >= 0).all()
    assert_close(model.loss_weights, (0.3, 1.0))
