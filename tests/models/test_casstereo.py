import pytest
import torch

from stereokit import build_model
from stereokit.losses import masked_cross_entropy

AROUND = {"name": "neighborhood_range", "planes": 24}
WIDE = {"aggregation": {"channels": 32}}
FIRST = {"stride": 4, "loss_weight": 0.5, "candidates": {"name": "uniform", "per_plane": 4}, **WIDE}
SECOND = {"stride": 2, "candidates": AROUND, **WIDE}
THIRD = {
    "backbone": {"finest": 1},
    "candidates": {"planes": 12, "spacing": 0.5},
    "aggregation": {"channels": 16},
}


def volume(*widths):
    projection = {"widths": list(widths), "activation": "relu", "bias": False}
    parts = [
        {"name": "groupwise_correlation", "group_channels": 8},
        {"name": "concatenation", "projection": projection},
    ]
    return {"cost": {"name": "combined", "parts": parts}}


@pytest.mark.parametrize(
    ("name", "parameters", "costs"),
    [
        ("casstereo_psm", 11_401_216, ({}, {}, {})),
        ("casstereo_gwc", 12_077_264, (volume(128, 12), volume(6), volume(3))),
    ],
)
def test_a_third_stage_is_an_override(name, parameters, costs):
    first, second, third = costs
    model = build_model(name, coarse=[FIRST | first, SECOND | second], max_disparity=64, **THIRD, **third)
    assert sum(p.numel() for p in model.parameters()) == parameters
    assert [stage.stride for stage in (*model.coarse, model)] == [4, 2, 1]
    assert [stage.cost.out_channels for stage in (*model.coarse, model)] == [64, 32, 16]
    assert [stage.cost.planes for stage in (*model.coarse, model)] == [4, 12, 12]
    output = model.eval()(*torch.rand(2, 1, 3, 32, 48))
    assert output.disparity.shape == (1, 32, 48)
    assert build_model(model.config).config == model.config


def test_stages_weigh_as_published():
    heads = (0.5, 0.5, 0.7, 1.0)
    assert build_model("casstereo_psm", max_disparity=64).loss_weights == (*(0.5 * w for w in heads), *heads)


def test_no_gradient_goes_from_a_stage_to_the_one_before():
    model = build_model("casstereo_gwc", max_disparity=64)
    model(*torch.rand(2, 2, 3, 32, 48)).disparity.sum().backward()
    assert all(p.grad is None for p in model.coarse.parameters())
    assert model.backbone.base.stem[0][0].weight.grad.any()


def test_distributions_know_their_planes():
    """Those of the volume, of which each holds several candidates; a loss over them works."""
    model = build_model("casstereo_psm", max_disparity=64)
    output = model(*torch.rand(2, 2, 3, 32, 48))
    for prediction in output.predictions:
        found = prediction.distribution
        assert found.values.shape == found.logits.shape
        assert masked_cross_entropy(found, torch.full((2, 32, 48), 20.0)).isfinite()
    first = output.predictions[0].distribution
    assert first.values[0, :, 0, 0].tolist() == [6.0, 22.0, 38.0, 54.0]
