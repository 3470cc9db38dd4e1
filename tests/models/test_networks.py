import pytest

from stereokit import (
    ConcatenationVolume,
    CorrelationVolume,
    EncoderDecoder,
    Hourglass,
    ResidualTower,
    SoftArgmin,
    SpatialPyramid,
    StackedHourglass,
    StereoModel,
    SuperpixelUpsampler,
    TopKSoftArgmin,
    UNet,
    build_model,
)
from stereokit.upsampling.interpolation import NoUpsampler, TrilinearUpsampler


@pytest.mark.parametrize(("name", "parameters"), [("coex", 2721993), ("psmnet", 5224768), ("gcnet", 2845376)])
def test_networks_have_the_published_size(name, parameters):
    model = build_model(name)
    assert isinstance(model, StereoModel)
    assert sum(p.numel() for p in model.parameters()) == parameters
    assert model.config["name"] == name
    assert model.max_disparity == model.config["max_disparity"] == 192


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        ("coex", [UNet, CorrelationVolume, Hourglass, TopKSoftArgmin, SuperpixelUpsampler]),
        ("psmnet", [SpatialPyramid, ConcatenationVolume, StackedHourglass, SoftArgmin, TrilinearUpsampler]),
        ("gcnet", [ResidualTower, ConcatenationVolume, EncoderDecoder, SoftArgmin, NoUpsampler]),
    ],
)
def test_networks_are_made_of_the_published_blocks(name, kinds):
    model = build_model(name)
    blocks = [model.backbone, model.cost, model.aggregation, model.regression, model.upsampler]
    assert [type(block) for block in blocks] == kinds


@pytest.mark.parametrize(("name", "weights"), [("coex", (0.3,)), ("psmnet", (0.5, 0.7)), ("gcnet", ())])
def test_networks_have_the_published_loss_weights(name, weights):
    assert build_model(name).auxiliary_weights == weights


def test_coex_keeps_the_two_best():
    assert build_model("coex").regression.k == build_model("coex").regression.test_k == 2
