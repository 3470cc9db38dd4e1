import pytest
import torch
from torch.nn import functional as F
from torch.testing import assert_close

from stereokit import ConfigError, build_model, load_published
from tests.golden import published_state, recording, save_checkpoint
from tests.shared import needs_shared

ADAPTIVE = {"name": "adaptive", "modules": 1, "deformable": 0}


@needs_shared
@pytest.mark.slow
@pytest.mark.parametrize(("name", "recorded"), [("aanet", "aanet"), ("aanet_plus", "aanetplus")])
def test_every_output_is_that_of_the_published_network(name, recorded, tmp_path):
    path = save_checkpoint(published_state(recorded, (0.4, 0.65)), tmp_path / "published.ckpt")
    model, expected = load_published(path, name), recording(recorded)
    # all outputs, while the norms stay in eval mode
    model.training = model.aggregation.training = True
    with torch.inference_mode():
        predictions = model(expected["left"], expected["right"]).predictions
    assert [p.stride for p in predictions] == [12, 6, 3, 2, 1]
    logits = predictions[0].distribution.logits
    assert (logits - expected["logits_12"].reshape(logits.shape)).abs().max() < 1e-4 * expected["logits_12"].std()
    for prediction in predictions:
        key = "disparity" if prediction.stride == 1 else f"disparity_{prediction.stride}"
        # there in pixels of its own resolution
        given = prediction.disparity / prediction.stride
        assert (given - expected[key].reshape(given.shape)).abs().max() < 0.01


def test_heads_of_coarser_scales_know_their_planes():
    model = build_model("aanet", max_disparity=48).train()
    predictions = model(*torch.rand(2, 2, 3, 48, 72)).predictions
    found = [
        (p.stride, p.distribution.stride, p.distribution.spacing, p.distribution.logits.shape[1])
        for p in predictions[:3]
    ]
    assert found == [(12, 12, 12, 4), (6, 6, 6, 8), (3, 3, 3, 16)]
    assert model.loss_weights == (1 / 3, 2 / 3, 1.0, 1.0, 1.0)


def test_each_scale_has_a_volume_of_its_own_features():
    model = build_model("aanet_plus", max_disparity=48)
    assert [(c.in_channels, c.planes) for c in (model.cost, *model.coarser_costs)] == [(32, 16), (64, 8), (128, 4)]


@pytest.mark.parametrize("upsampler", ["bilinear", "trilinear", "superpixel"])
def test_volumes_that_are_missing_are_averaged(upsampler):
    model = build_model("coex", aggregation=ADAPTIVE, upsampler=upsampler, guidance="none", max_disparity=64).train()
    assert len(model.coarser_costs) == 0
    seen = []
    model.aggregation.register_forward_pre_hook(lambda _, given: seen.extend(given[0]))
    output = model(*torch.rand(2, 2, 3, 64, 64))
    assert_close(seen[1], F.avg_pool3d(seen[0], 2))
    assert_close(seen[2], F.avg_pool3d(seen[0], 4))
    assert len(output.predictions) == len(model.loss_weights)
    scale = 4 if upsampler != "superpixel" else 1
    coarse = [16, 8] if upsampler != "trilinear" else [16 // scale, 8 // scale]
    assert [p.stride for p in output.predictions[:2]] == coarse
    assert output.predictions[-1].stride == 1
    # a peak at plane 1 of the coarsest scale is at 16 px
    logits = torch.full((1, 4, 1, 1), -100.0)
    logits[:, 1] = 100
    coarsest = output.predictions[0].distribution
    assert coarsest.spacing == 16
    assert_close(model.regression(logits) * coarsest.spacing, torch.full((1, 1, 1), 16.0))


def test_a_cost_made_elsewhere_has_one_scale():
    given = build_model("aanet", max_disparity=48).cost
    assert len(build_model("aanet", max_disparity=48, cost=given).coarser_costs) == 0


def test_costs_of_other_widths_are_refused():
    with pytest.raises(
        ConfigError, match=r"ConcatenationVolume at stride 6 gives volume channels: 128, but .* wants 64"
    ):
        build_model("aanet_plus", max_disparity=48, cost="concatenation")
    projected = {"name": "concatenation", "projection": [16]}
    assert build_model("aanet_plus", max_disparity=48, cost=projected).aggregation.in_channels == 32


def test_it_works_behind_a_coarser_stage():
    model = build_model(
        "gwcnet_g",
        backbone={"name": "top_down_pyramid", "base": "gwc_trunk"},
        coarse=[{"stride": 4, "aggregation": {"name": "gwc_hourglass", "channels": 8}}],
        stride=2,
        candidates={"name": "neighborhood_range", "planes": 16},
        cost={"name": "groupwise_correlation", "groups": 8, "group_channels": None},
        aggregation=ADAPTIVE,
        max_disparity=32,
    ).train()
    output = model(*torch.rand(2, 2, 3, 64, 64))
    assert len(output.predictions) == len(model.loss_weights)
    # the planes of a coarser scale are those of its own logits
    for prediction in output.predictions[4:]:
        assert prediction.distribution.values.shape == prediction.distribution.logits.shape
    # it compares at both strides
    assert len(model.coarser_costs) == 1
    sum(prediction.disparity.sum() for prediction in output.predictions).backward()
    assert all(p.grad.isfinite().all() for p in model.aggregation.parameters())


def test_coarse_outputs_are_for_training_alone():
    aggregation = build_model("aanet").aggregation
    unread = (*aggregation.stack[-1].across.exchange[1:], *aggregation.heads[1:])
    assert sum(p.numel() for block in unread for p in block.parameters()) == 4_002_956 - 3_931_676
