import json
import re

import numpy as np
import pytest
import timm
import torch
from torch import nn

from stereokit import (
    GCE,
    ConfigError,
    CorrelationVolume,
    Hourglass,
    ResidualTower,
    SoftArgmin,
    StereoModel,
    StereoNetwork,
    StereoOutput,
    TopKSoftArgmin,
    UNet,
    build_model,
    coex,
    list_models,
)
from stereokit.compose import compose
from stereokit.config import ModelConfig
from stereokit.guidance import GuidancePoint, NoGuidance
from stereokit.models.ablation import ABLATION
from stereokit.registry import AGGREGATIONS, COSTS, MODELS
from stereokit.upsampling.interpolation import BilinearUpsampler, TrilinearUpsampler
from tests.backbones.test_encoder import ENCODERS


def shapes(model):
    return {key: tuple(value.shape) for key, value in model.state_dict().items()}


def run(model, height=32, width=64):
    """Forward and backward; every output and gradient is finite."""
    output = model.train()(torch.rand(2, 3, height, width), torch.rand(2, 3, height, width))
    sum(disparity.sum() for disparity in (output.disparity, *output.auxiliary)).backward()
    assert output.disparity.shape == (2, height, width)
    assert output.disparity.isfinite().all()
    assert all(p.grad.isfinite().all() for p in model.parameters() if p.grad is not None)
    return output


@pytest.mark.parametrize(
    ("slot", "choice", "kind", "resolved"),
    [
        ("backbone", "residual", ResidualTower, {"name": "residual", "channels": 32, "blocks": 8}),
        (
            "backbone",
            {"name": "residual", "blocks": 1},
            ResidualTower,
            {"name": "residual", "channels": 32, "blocks": 1},
        ),
        ("cost", "correlation", CorrelationVolume, {"name": "correlation", "projection": [48, 48]}),
        ("cost", {"projection": None}, CorrelationVolume, {"name": "correlation", "projection": None}),
        ("cost", {"projection": (8, 6)}, CorrelationVolume, {"name": "correlation", "projection": [8, 6]}),
        ("regression", "soft_argmin", SoftArgmin, {"name": "soft_argmin", "include_end": False}),
        ("regression", {"k": 5}, TopKSoftArgmin, {"name": "top_k", "k": 5, "test_k": None}),
        ("regression", {"name": "top_k", "test_k": 3}, TopKSoftArgmin, {"name": "top_k", "k": 2, "test_k": 3}),
        ("upsampler", "bilinear", BilinearUpsampler, {"name": "bilinear", "align_corners": False}),
        (
            "upsampler",
            {"name": "trilinear"},
            TrilinearUpsampler,
            {"name": "trilinear", "planes_scale": None, "align_corners": False, "include_end": False},
        ),
        (
            "aggregation",
            {"channels": [4, 8, 8, 8]},
            Hourglass,
            {"name": "hourglass", "channels": [4, 8, 8, 8], "guide_early": False},
        ),
    ],
)
def test_an_override_is_a_name_or_arguments(slot, choice, kind, resolved):
    # GC-Net's tower has neither a guide at stride 4 nor one beyond 2; plain upsampling goes with it
    plain = {"guidance": "none", "upsampler": "bilinear"} if kind is ResidualTower else {}
    model = build_model("coex", **{**plain, slot: choice})
    assert isinstance(getattr(model, slot), kind)
    assert model.config[slot] == resolved


@pytest.mark.parametrize(
    ("slot", "block"),
    [
        ("backbone", UNet(encoder="resnet18")),
        ("cost", CorrelationVolume(in_channels=96, planes=16)),
        ("aggregation", Hourglass(in_channels=1, channels=(2, 2, 2, 2))),
        ("regression", SoftArgmin()),
        ("upsampler", BilinearUpsampler(scale=4)),
    ],
)
def test_an_override_is_an_instance(slot, block):
    model = build_model("coex", max_disparity=64, **{slot: block})
    assert getattr(model, slot) is block
    assert model.config[slot] == {"instance": f"{type(block).__module__}.{type(block).__qualname__}"}
    run(model)


def test_a_guidance_instance_takes_the_one_place():
    block = GCE(96, 8)
    model = build_model("coex", max_disparity=64, guidance=block, guidance_at="one")
    assert model.aggregation.stem_guidance.block is block
    assert model.config["guidance"] == {"instance": "stereokit.guidance.excitation.GCE"}
    run(model)
    assert all(p.grad is not None for p in block.parameters())


def test_a_guidance_instance_without_channels_is_taken_at_its_word():
    class Mine(nn.Module):
        def forward(self, volume, guide):
            return volume

    run(build_model("coex", max_disparity=64, guidance=Mine(), guidance_at="one"))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"guidance": GCE(96, 8)}, ["GCE", "several places", "use guidance_at='one'"]),
        ({"guidance": GCE(95, 8), "guidance_at": "one"}, ["GCE", "guide_channels 95", "has 96"]),
        ({"guidance": GCE(96, 9), "guidance_at": "one"}, ["GCE", "volume_channels 9", "has 8"]),
        ({"guidance": "gec"}, ["unknown guidance 'gec'", "'gce'"]),
        ({"guidance": {"name": "gce", "window": 3}}, ["guidance 'gce' takes no argument 'window'"]),
        ({"guidance": {"name": "neighborhood", "window": 2}}, ["window=2"]),
        ({"guidance_at": "none"}, ["guidance_at='none'", "use 'one' or 'full', or guidance='none'"]),
        ({"guidance": "none", "guidance_at": "two"}, ["guidance_at='two'"]),
        ({"cost": "corelation"}, ["unknown cost 'corelation'", "'correlation'"]),
        ({"cost": {"projektion": [8, 8]}}, ["cost 'correlation' takes no argument 'projektion'", "'projection'"]),
        ({"cost": {"projection": 8}}, ["cost 'correlation' can't be built with projection=8"]),
        ({"cost": {"projection": []}}, ["a projection has one width or more"]),
        (
            {"cost": {"projection": {"width": [8]}}},
            ["a projection has widths, an activation, a bias and a last_kernel", "width"],
        ),
        ({"cost": {"name": 5}}, ["the name of a cost is a string, not 5"]),
        ({"cost": {"name": ["correlation"]}}, ["the name of a cost is a string"]),
        ({"cost": 5}, ["cost=5: expected a component's name, a dict", "or a module"]),
        ({"cost": None}, ["cost=None: expected a component's name"]),
        ({"cost": nn.Identity()}, ["cost Identity lacks in_channels, out_channels, planes"]),
        (
            {"cost": CorrelationVolume(in_channels=97, planes=48)},
            ["backbone UNet", "cost CorrelationVolume", "96", "97"],
        ),
        ({"cost": CorrelationVolume(in_channels=96, planes=47)}, ["backbone UNet", "CorrelationVolume", "47", "48"]),
        ({"cost": {"projection": (8, np.int64(8))}}, ["plain JSON", "int64"]),
        ({"aggregation": Hourglass(in_channels=2)}, ["cost CorrelationVolume", "aggregation Hourglass", "1", "2"]),
        ({"aggregation": {"channels": [8, 16]}}, ["channels=[8, 16]", "those of the stem, and of two or three scales"]),
        ({"upsampler": BilinearUpsampler(scale=8)}, ["aggregation Hourglass", "upsampler BilinearUpsampler", "4", "8"]),
        (
            {"refinements": [{"name": "edge_aware", "stride": 8}]},
            ["first refinement works at stride 8", "aggregation 'hourglass' gives logits of stride 4"],
        ),
        ({"upsampler": "none"}, ["aggregation Hourglass", "upsampler NoUpsampler", "4", "1"]),
        ({"regression": nn.Identity()}, ["regression Identity lacks min_levels, with_confidence"]),
        ({"backbone": "spatial_pyramidd"}, ["unknown backbone 'spatial_pyramidd'", "'spatial_pyramid'"]),
        ({"backbone": "resnet19"}, ["unknown backbone 'resnet19'", "a timm model, such as 'resnet18' or "]),
        ({"backbone": {"encoder": "resnet81"}}, ["unknown timm model 'resnet81'", "'resnet18'"]),
        ({"backbone": "vit_tiny_patch16_224"}, ["no features at stride 4, 8, 32"]),
        ({"top_k": 0}, ["k=0", "whole number"]),
        ({"top_k": 49}, ["TopKSoftArgmin", "Hourglass", "49", "48", "use k from 1 to 48"]),
        ({"regression": {"test_k": 49}}, ["TopKSoftArgmin", "49", "use k from 1 to 48"]),
        ({"top_k": 2, "regression": "soft_argmin"}, ["one of top_k and regression"]),
        (
            {"max_disparity": 100},
            ["100", "multiple of 32", "'unet'", "'hourglass'", "use 96 or 128"],
        ),
        ({"max_disparity": 30}, ["30", "multiple of 32", "; use 32"]),
        ({"max_disparity": 2}, ["2", "multiple of 32", "; use 32"]),
        ({"max_disparity": 0}, ["max_disparity 0", "; use 32"]),
        ({"max_disparity": -64}, ["max_disparity -64", "; use 32"]),
        ({"max_disparity": True}, ["whole number of pixels, not True"]),
        ({"max_disparity": "192"}, ["whole number of pixels, not '192'"]),
        ({"max_disparity": 192.0}, ["whole number of pixels, not 192.0"]),
        ({"padding": "reflect"}, ["padding='reflect'", "use 'replicate', 'zeros' or 'black'"]),
        ({"mean": [0.5]}, ["mean is three numbers", "[0.5]"]),
        ({"std": [1, 1, 0]}, ["std is three positive numbers", "[1, 1, 0]"]),
        ({"std": "abc"}, ["std is three positive numbers", "'abc'"]),
        ({"backbones": "unet"}, ["model 'coex' takes no argument 'backbones'", "did you mean 'backbone'"]),
        ({"name": "psmnet"}, ["model 'coex' takes no argument 'name'"]),
        ({"pretrained_backbone": True, "backbone": UNet()}, ["UNet", "passed in as a module", "pretrained_backbone"]),
        ({"pretrained_backbone": True, "backbone": "spatial_pyramid"}, ["'spatial_pyramid' has no pretrained weights"]),
    ],
)
def test_what_does_not_fit_is_named(overrides, words):
    with pytest.raises(ConfigError) as error:
        build_model("coex", **overrides)
    for word in words:
        assert word in str(error.value)
    assert "\n" not in str(error.value)


def test_unknown_models_are_answered_with_near_ones():
    with pytest.raises(ConfigError, match=r"unknown model 'psmnett'; did you mean 'psmnet'"):
        build_model("psmnett")
    for configuration in ({}, {"name": None}, {"cost": "correlation"}):
        with pytest.raises(ConfigError, match=r"the name of its model, one of .*coex.*psmnet"):
            build_model(configuration)


@pytest.mark.parametrize("encoder", ENCODERS)
def test_any_pyramid_of_timm_is_a_backbone(encoder):
    model = build_model("coex", backbone=encoder, max_disparity=64)
    chosen = model.config["backbone"]
    assert chosen == {**chosen, "name": "unet", "encoder": encoder, "stem_channels": [32, 48], "norm": "batch"}
    run(model)


def test_a_timm_backbone_takes_arguments_of_the_unet():
    model = build_model("coex", backbone={"name": "resnet18", "stem_channels": [8, 12]})
    assert model.backbone.info.guide_channels[2] == 8
    chosen = model.config["backbone"]
    assert chosen == {**chosen, "name": "unet", "encoder": "resnet18", "stem_channels": [8, 12], "norm": "batch"}


@pytest.mark.parametrize("pretrained", [False, True])
def test_pretrained_backbone_passes_to_timm(monkeypatch, pretrained):
    asked = []
    create = timm.create_model

    def spy(name, *, pretrained=False, **arguments):
        asked.append(pretrained)
        return create(name, **arguments)

    monkeypatch.setattr(timm, "create_model", spy)
    model = build_model("coex", pretrained_backbone=pretrained)
    explicit = build_model("coex", backbone={"pretrained": pretrained})
    assert asked == [pretrained, pretrained]
    # the weights at the start are no part of the network: rebuilding it must not fetch them
    assert "pretrained" not in json.dumps([model.config, explicit.config])


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("gcnet", {"guidance": "gce", "guidance_at": "one"}),
        ("gcnet", {"guidance": "gce", "guidance_at": "full", "top_k": 4}),
        ("gcnet", {"guidance": "neighborhood"}),
        ("gcnet", {"cost": "correlation"}),
        ("gcnet", {"backbone": "spatial_pyramid", "upsampler": "superpixel"}),
        ("gcnet", {"backbone": "mobilenetv2_100", "upsampler": "trilinear"}),
        ("psmnet", {"upsampler": "superpixel"}),
        ("psmnet", {"upsampler": "superpixel", "guidance": "gce", "guidance_at": "full", "top_k": 2}),
        ("psmnet", {"upsampler": "bilinear", "cost": "correlation"}),
        ("psmnet", {"aggregation": "hourglass", "cost": "correlation", "guidance": "addition", "guidance_at": "full"}),
        ("psmnet", {"backbone": "resnet18"}),
        ("psmnet", {"aggregation": "encoder_decoder"}),
        ("coex", {"cost": "concatenation"}),
        ("coex", {"cost": "groupwise_correlation"}),
        ("coex", {"cost": {"name": "groupwise_correlation", "groups": 4, "normalise": True}}),
        ("coex", {"aggregation": "encoder_decoder", "upsampler": "trilinear"}),
        ("coex", {"aggregation": "encoder_decoder", "guidance_at": "full", "upsampler": "superpixel"}),
        ("coex", {"aggregation": "stacked_hourglass", "upsampler": "trilinear", "top_k": 64}),
        ("coex", {"backbone": "spatial_pyramid"}),
        ("coex", {"backbone": "residual", "guidance_at": "full"}),
        ("coex", {"guidance": {"name": "neighborhood", "window": 5}, "guidance_at": "one"}),
        ("coex", {"upsampler": {"padding": "zeros"}, "padding": "zeros"}),
    ],
)
def test_crossings_train_and_rebuild(name, overrides):
    model = build_model(name, max_disparity=64, **overrides)
    run(model)
    twin = build_model(json.loads(json.dumps(model.config)))
    assert twin.config == model.config
    assert shapes(twin) == shapes(model)


def test_auxiliary_outputs_have_weights_wherever_they_come_from():
    for overrides, weights in (
        ({}, (0.5, 0.7)),
        ({"upsampler": "superpixel"}, (0.5, 0.7, 0.3)),
        ({"aggregation": "hourglass", "upsampler": "bilinear"}, ()),
        ({"aggregation": "hourglass", "upsampler": "superpixel"}, (0.3,)),
    ):
        model = build_model("psmnet", max_disparity=32, **overrides)
        assert model.auxiliary_weights == weights
        assert len(run(model).auxiliary) == len(weights)


@pytest.mark.parametrize("max_disparity", [32, 64, 96, 128, 256, 320])
@pytest.mark.parametrize("name", ["coex", "psmnet", "gcnet", "casstereo_psm", "stereonet_8x"])
def test_other_ranges_of_disparity_rebuild(name, max_disparity):
    if max_disparity % (step := 64 if name.startswith("casstereo") else 32):
        with pytest.raises(ConfigError, match=f"not a positive multiple of {step}"):
            build_model(name, max_disparity=max_disparity)
        return
    model = build_model(name, max_disparity=max_disparity)
    first = (*model.coarse, model)[0]
    assert first.cost.planes * first.candidates.per_plane * first.stride == max_disparity
    assert build_model(model.config).max_disparity == max_disparity


@pytest.mark.parametrize(("name", "step"), [("coex", 32), ("psmnet", 16), ("gcnet", 32), ("casstereo_psm", 64)])
def test_ranges_that_would_do_are_offered_and_do(name, step):
    for wrong in (10 * step + 1, 10 * step + step // 2, 11 * step - 1):
        with pytest.raises(ConfigError) as error:
            build_model(name, max_disparity=wrong)
        offers = [int(d) for d in re.findall(r"\d+", str(error.value).split(";")[1])]
        assert offers == [10 * step, 11 * step]
    assert [build_model(name, max_disparity=offer).max_disparity for offer in offers] == offers


@pytest.mark.parametrize("row", ABLATION, ids=str)
def test_the_configuration_of_every_ablation_row_rebuilds_it(row):
    model = build_model(row.model, **row.overrides)
    twin = build_model(json.loads(json.dumps(model.config)))
    assert twin.config == model.config
    assert shapes(twin) == shapes(model)


@pytest.mark.parametrize("name", list_models())
def test_configurations_are_plain_and_complete(name):
    model = build_model(name)
    config = model.config
    assert json.loads(json.dumps(config)) == config
    if isinstance(model, StereoModel):
        assert set(config) == set(ModelConfig.__annotations__)
    assert config["name"] == name


def test_a_configuration_takes_overrides():
    config = build_model("coex", cost="concatenation", backbone="resnet18").config
    model = build_model(config, top_k=3, max_disparity=96)
    assert model.config == {
        **config,
        "regression": {"name": "top_k", "k": 3, "test_k": None},
        "max_disparity": 96,
    }
    assert build_model(config, regression="soft_argmin").config["regression"]["name"] == "soft_argmin"


def test_a_configuration_is_left_as_it_is():
    config = build_model("coex").config
    before = json.dumps(config)
    build_model(config, top_k=3, cost={"projection": [8, 8]})
    assert json.dumps(config) == before
    model = build_model(config)
    model.config["cost"]["projection"] = None
    assert build_model("coex").config == config


def test_a_configuration_with_an_instance_says_what_to_do():
    config = build_model("coex", regression=TopKSoftArgmin(3)).config
    with pytest.raises(ConfigError, match=r"TopKSoftArgmin that was passed in as a module.*regression=\.\."):
        build_model(config)
    assert build_model(config, regression=SoftArgmin()).config["regression"]["instance"].endswith("SoftArgmin")


def test_preprocessing_is_an_override():
    model = build_model("coex", mean=[0, 0, 0], std=(1, 1, 1), padding="zeros")
    assert model.mean.dtype == model.std.dtype == torch.float32
    assert model.mean.shape == (3, 1, 1)
    assert (model.config["mean"], model.config["std"], model.config["padding"]) == ([0, 0, 0], [1, 1, 1], "zeros")
    assert build_model(model.config).config == model.config


def test_a_recipe_sets_arguments_that_an_override_may_leave():
    config = build_model("coex").config
    recipe = {**config, "regression": {"name": "top_k", "k": 5, "test_k": 3}, "upsampler": {"name": "bilinear"}}
    model = compose(recipe, {"cost": {"groupwise_correlation": {"groups": 3}}}, {"regression": {"test_k": 4}})
    assert (model.regression.k, model.regression.test_k) == (5, 4)
    other = compose(recipe, {"cost": {"groupwise_correlation": {"groups": 3}}}, {"cost": "groupwise_correlation"})
    assert (other.cost.groups, other.regression.test_k) == (3, 3)
    # another name is another component: what the recipe says about its own does not carry over
    projected = {**recipe, "cost": {"name": "correlation", "projection": [8, 8]}}
    assert compose(projected, {}, {"cost": "concatenation"}).config["cost"]["projection"] is None


def test_recipes_are_functions():
    assert coex(top_k=3).config == build_model("coex", top_k=3).config
    assert coex.__name__ == "coex"


def test_no_guidance_leaves_no_weights():
    model = build_model("coex", guidance="none")
    points = [m for m in model.modules() if isinstance(m, GuidancePoint)]
    assert points
    assert all(isinstance(point.block, NoGuidance) for point in points)
    assert model.aggregation.guide_channels == {}


@pytest.fixture
def registered(monkeypatch):
    """Registries that forget what a test adds."""
    for registry in (AGGREGATIONS, COSTS, MODELS):
        monkeypatch.setattr(registry, "_factories", dict(registry._factories))


@pytest.mark.usefixtures("registered")
def test_a_new_component_fills_its_slot():
    @COSTS.register("gained")
    class Difference(nn.Module):
        def __init__(self, *, in_channels, planes, gain=2.0):
            super().__init__()
            self.in_channels, self.out_channels, self.planes = in_channels, in_channels, planes
            self.gain = gain
            self.warps = False

        def forward(self, left, right):
            shifted = [right.roll(d, -1) for d in range(self.planes)]
            return self.gain * (left.unsqueeze(2) - torch.stack(shifted, 2)).abs()

    model = build_model("coex", max_disparity=64, cost="gained")
    run(model)
    assert model.config["cost"] == {"name": "gained", "gain": 2.0}
    assert build_model(model.config, cost={"name": "gained", "gain": 1.0}).cost.gain == 1


@pytest.mark.usefixtures("registered")
def test_a_component_without_the_attributes_of_its_slot_is_refused():
    @COSTS.register("bare")
    class Bare(nn.Module):
        def __init__(self, *, in_channels):
            super().__init__()
            self.in_channels = in_channels

    with pytest.raises(ConfigError, match="cost Bare lacks out_channels, planes"):
        build_model("coex", cost="bare")


@pytest.mark.usefixtures("registered")
def test_a_network_without_slots_is_built_and_described_by_name():
    @MODELS.register("constant")
    class Constant(StereoNetwork):
        def __init__(self, *, value=1.0, max_disparity=64):
            super().__init__(max_disparity=max_disparity)
            self.value = value

        def match(self, left, right):
            return StereoOutput(torch.full_like(left[:, 0], self.value))

    model = build_model("constant", value=3.0)
    assert model.config == {"name": "constant", "value": 3.0, "max_disparity": 64}
    assert build_model(model.config, value=2.0)(*torch.rand(2, 1, 3, 32, 40)).disparity.unique() == 2
    with pytest.raises(ConfigError, match="model 'constant' takes no argument 'valeu'; did you mean 'value'"):
        build_model("constant", valeu=3.0)


@pytest.mark.usefixtures("registered")
def test_what_is_no_network_is_refused():
    MODELS.register("number")(lambda: 3.0)
    with pytest.raises(ConfigError, match="model 'number' is a float, not a StereoNetwork"):
        build_model("number")


@pytest.mark.usefixtures("registered")
def test_guidance_that_an_aggregation_has_no_place_for_is_refused():
    @AGGREGATIONS.register("blind")
    class Blind(Hourglass):
        def __init__(self, *, in_channels):
            super().__init__(in_channels=in_channels)

    with pytest.raises(ConfigError, match=r"aggregation 'blind' has no place for guidance 'gce'.*use guidance='none'"):
        build_model("coex", aggregation="blind")
    model = build_model("coex", aggregation="blind", guidance="none")
    assert model.config["guidance"] == {"name": "none"}
    with pytest.raises(ConfigError, match="Hourglass was passed in as a module, with its guidance in it"):
        build_model("coex", aggregation=Hourglass(in_channels=1), guidance="gce")
    # of a module it is not known what guides it
    assert "instance" in build_model("coex", aggregation=Hourglass(in_channels=1)).config["guidance"]


def test_places_of_no_guidance_are_refused():
    with pytest.raises(ConfigError, match="guidance_at='one' has no effect with guidance 'none'"):
        build_model("coex", guidance="none", guidance_at="one")
    full = build_model("psmnet", guidance="gce", guidance_at="full")
    without = build_model(full.config, guidance="none").config
    assert (without["guidance"], without["guidance_at"]) == ({"name": "none"}, "one")
    assert build_model(without).config == without


def test_a_dict_without_a_name_changes_what_the_configuration_holds():
    made = build_model("coex", regression={"name": "top_k", "k": 6, "test_k": 3}, guidance="addition", max_disparity=64)
    again = build_model(made.config, regression={"test_k": 4}, guidance={})
    assert again.config["regression"] == {"name": "top_k", "k": 6, "test_k": 4}
    assert again.config["guidance"]["name"] == "addition"


@pytest.mark.parametrize(
    "override", [{"aggregation": {"guidance_at": "one"}}, {"cost": {"in_channels": 96}}, {"upsampler": {"scale": 4}}]
)
def test_what_the_network_decides_is_no_choice(override):
    with pytest.raises(ConfigError, match="follows from the rest of the network"):
        build_model("coex", **override)


@pytest.mark.parametrize("model", [5, None, ["coex"]])
def test_a_model_is_a_name_or_a_configuration(model):
    with pytest.raises(ConfigError, match="is a name or a configuration"):
        build_model(model)


def test_models_of_a_fixed_image_size_are_refused():
    with pytest.raises(ConfigError, match="one fixed size"):
        build_model("coex", backbone="swin_tiny_patch4_window7_224")
