import datetime
import json
import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from stereokit.builder import build_model
from stereokit.errors import ConfigError
from stereokit.training import (
    Averaging,
    Loss,
    Optimisation,
    Recipe,
    Schedule,
    list_recipes,
    load_recipe,
    with_length,
)
from tests.training.test_schedule import schedules
from tests.training.tiny import TINY

share = st.floats(0, 0.999)


@pytest.mark.parametrize("name", list_recipes())
def test_every_recipe_loads_and_survives_json(name):
    recipe = load_recipe(name)
    assert Recipe.from_dict(json.loads(json.dumps(recipe.to_dict()))) == recipe
    assert recipe.scenes or recipe.data
    options = {key: value for key, value in recipe.model.items() if key not in ("name", "pretrained_backbone")}
    assert build_model(recipe.model["name"], **options).loss_weights


@pytest.mark.parametrize("key", ["seed", "textures"])
def test_what_belongs_to_a_run_is_refused_in_a_recipe(key):
    values = load_recipe("synthetic").to_dict()
    with pytest.raises(ConfigError, match=rf"\[scenes\]: {key} belongs to a run \(--{key}\)"):
        Recipe.from_dict({**values, "scenes": {**values["scenes"], key: 3}})


def test_the_recipes_of_the_papers():
    sceneflow, kitti = load_recipe("sceneflow"), load_recipe("kitti-finetune")
    crop = sceneflow.augmentation.crop_height, sceneflow.augmentation.crop_width
    assert (crop, sceneflow.schedule.batch, sceneflow.optimisation.gradient_clip) == ((288, 576), 8, 0.1)
    rates = [sceneflow.schedule.learning_rate_factor(epoch / 10) for epoch in range(10)]
    assert rates == pytest.approx([1.0] * 7 + [0.1] * 3)
    assert sceneflow.loss.max_disparity == 192
    assert kitti.loss.max_disparity is None
    rates = [kitti.schedule.learning_rate_factor(epoch / 800) for epoch in (29, 30, 50, 299, 300, 799)]
    assert rates == pytest.approx([1, 0.5, 0.25, 0.25, 0.125, 0.125])
    psmnet = load_recipe("psmnet-kitti")
    rates = [psmnet.schedule.learning_rate_factor(epoch / 300) for epoch in (0, 199, 200, 299)]
    assert rates == pytest.approx([1, 1, 0.1, 0.1])


@st.composite
def recipes(draw):
    schedule = draw(schedules())
    optimisation = draw(
        st.one_of(
            st.builds(Optimisation, kind=st.sampled_from(["adam", "adamw"]), betas=st.tuples(share, share)),
            st.builds(Optimisation, kind=st.just("rmsprop"), smoothing=share, weight_decay=st.floats(0, 1)),
            st.builds(
                Optimisation, gradient_clip=st.floats(0.1, 9), gradient_clip_by=st.sampled_from(["norm", "value"])
            ),
        )
    )
    arguments = st.dictionaries(st.text(), st.one_of(st.floats(-1, 1), st.lists(st.integers()), st.booleans()))
    kind = st.one_of(st.text(), st.builds(lambda name, rest: {**rest, "name": name}, st.text(), arguments))
    loss = draw(st.builds(Loss, kind=kind, max_disparity=st.one_of(st.none(), st.floats(1, 300)), cross_entropy=share))
    return replace(TINY, schedule=schedule, optimisation=optimisation, loss=loss)


@given(recipes())
def test_recipes_survive_json(recipe):
    assert Recipe.from_dict(json.loads(json.dumps(recipe.to_dict()))) == recipe


@given(recipes(), st.integers(1, 1000), st.integers(1, 64))
def test_another_length_changes_nothing_else(recipe, steps, batch):
    other = with_length(recipe, steps=steps, batch=batch)
    assert (other.schedule.total_steps(9), other.schedule.batch) == (steps, batch)
    assert replace(other, schedule=recipe.schedule) == recipe


def test_a_recipe_from_before_a_setting_existed_means_the_same():
    values = TINY.to_dict()
    for section, keys in {
        "schedule": ["kind", "every", "initial", "final", "shape"],
        "optimisation": ["kind", "smoothing", "weight_decay", "gradient_clip_by"],
        "loss": ["kind"],
    }.items():
        values[section] = {key: value for key, value in values[section].items() if key not in keys}
    assert Recipe.from_dict(values) == TINY


@pytest.mark.parametrize(
    ("settings", "kind", "options"),
    [
        ({}, torch.optim.Adam, {"betas": (0.9, 0.999), "weight_decay": 0}),
        ({"kind": "adamw", "betas": (0.8, 0.9), "weight_decay": 0.1}, torch.optim.AdamW, {"betas": (0.8, 0.9)}),
        ({"kind": "rmsprop", "smoothing": 0.9, "weight_decay": 0.2}, torch.optim.RMSprop, {"alpha": 0.9}),
    ],
)
def test_the_optimiser_is_what_the_recipe_says(settings, kind, options):
    optimisation = Optimisation(learning_rate=0.5, **settings)
    optimiser = optimisation.optimiser([("weight", torch.nn.Parameter(torch.ones(1)))])
    assert type(optimiser) is kind
    expected = {"lr": 0.5, "weight_decay": optimisation.weight_decay, **options}
    assert {key: optimiser.defaults[key] for key in expected} == expected


def test_some_weights_are_slower():
    optimisation = Optimisation(learning_rate=0.5, factors={"places": 0.1})
    names = ("conv.places.weight", "places.bias", "placeses.weight", "conv.weight")
    weights = {name: torch.nn.Parameter(torch.ones(1)) for name in names}
    optimiser = optimisation.optimiser(weights.items())
    rates = {id(p): group["lr"] for group in optimiser.param_groups for p in group["params"]}
    assert [rates[id(p)] for p in weights.values()] == [0.05, 0.05, 0.5, 0.5]
    with pytest.raises(ConfigError, match="no weight has 'places' in its name"):
        optimisation.optimiser([("weight", torch.nn.Parameter(torch.ones(1)))])
    with pytest.raises(ConfigError, match="factor of 'places' has to be a positive number"):
        Optimisation(factors={"places": -1})


ODD = {
    "date": datetime.date(2024, 5, 1),
    "list": [[1.0]],
    "fraction": 2.5,
    "inf": math.inf,
    "nan": math.nan,
    "bool": True,
    "text": "3",
}
REFUSED = {
    "schedule.batch": ODD,
    "schedule.steps": ODD,
    "schedule.warmup": ODD.keys() - {"fraction"},
    "schedule.factor": ODD.keys() - {"fraction"},
    "schedule.milestones": ODD,
    "optimisation.kind": ODD,
    "optimisation.learning_rate": ODD.keys() - {"fraction"},
    "optimisation.betas": ODD,
    "optimisation.weight_decay": ODD.keys() - {"fraction"},
    "optimisation.gradient_clip": ODD.keys() - {"fraction"},
    "loss.kind": ODD.keys() - {"text"},
    "loss.max_disparity": ODD.keys() - {"fraction"},
    "loss.cross_entropy": ODD.keys() - {"fraction"},
    "averaging.decay": ODD.keys() - {"fraction"},
    "averaging.kind": ODD,
    "augmentation.crop_height": ODD,
    "augmentation.flip": ODD.keys() - {"fraction"},
    "augmentation.scale_range": ODD,
    "scenes.size": ODD,
    "scenes.max_disparity": ODD.keys() - {"fraction"},
    "scenes.count": ODD,
    "model.name": ODD.keys() - {"text"},
    "model.pretrained_backbone": ODD.keys() - {"bool"},
    "model.max_disparity": ["date", "inf", "nan"],
}


@pytest.mark.parametrize(
    ("place", "kind"), [(place, kind) for place, kinds in REFUSED.items() for kind in sorted(kinds)]
)
def test_a_value_of_another_type_is_one_line(place, kind):
    values = TINY.to_dict()
    section, key = place.split(".")
    values[section] = {**values[section], key: ODD[kind]}
    with pytest.raises(ConfigError) as caught:
        Recipe.from_dict(values, "mine")
    said = str(caught.value)
    assert "\n" not in said
    assert "recipe 'mine'" in said
    assert f"{key} is " in said
    assert repr(ODD[kind]) in said
    assert "; expected " in said


def test_values_built_in_python_are_checked_too():
    for build, words in (
        (lambda: Schedule(batch=True, steps=3), "schedule: batch is True; expected a whole number"),
        (lambda: Optimisation(learning_rate="1e-3"), "optimisation: learning_rate is '1e-3'; expected a finite number"),
        (lambda: Loss(kind={"beta": 1}), "expected a name, or a table with a name in it"),
        (lambda: Loss(kind={"name": "x", "beta": math.nan}), r"loss: kind.beta is nan; expected text, a finite number"),
        (lambda: Averaging(start=None), "averaging: start is None; expected a finite number"),
        (lambda: replace(TINY, about=3), "recipe 'tiny': about is 3; expected text"),
    ):
        with pytest.raises(ConfigError, match=words):
            build()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"schedule": {"batch": 2}}, "steps or epochs"),
        ({"schedule": {"batch": 2, "steps": 3, "epochs": 3}}, "steps or epochs"),
        ({"schedule": {"batch": 0, "steps": 3}}, "batch must be positive"),
        ({"schedule": {"batch": 2, "epochs": 5, "milestones": [5]}}, "between 0 and 5"),
        ({"schedule": {"batch": 2, "steps": 5, "milestones": [3]}}, "parts of the run between 0 and 1"),
        ({"schedule": {"batch": 2, "steps": 5, "warmup": 1}}, "warmup"),
        ({"schedule": {"bach": 2, "steps": 5}}, "did you mean 'batch'"),
        ({"schedule": 3}, "expected a table"),
        ({"optimisation": {"learning_rate": -1}}, "learning_rate must be positive"),
        ({"optimisation": {"gradient_clip": 0}}, "gradient_clip must be positive"),
        ({"optimisation": {"betas": 0.9}}, "betas is 0.9; expected a list of 2 finite numbers"),
        ({"optimisation": {"betas": [0.9, 1]}}, "betas are two numbers"),
        ({"optimisation": {"kind": "rmsprop", "betas": [0.8, 0.9]}}, "betas = .* has no effect with kind 'rmsprop'"),
        ({"optimisation": {"kind": "sgd"}}, "'adam', 'adamw' or 'rmsprop'"),
        ({"optimisation": {"gradient_clip_by": "value"}}, "gradient_clip_by has no effect without gradient_clip"),
        ({"optimisation": {"weight_decay": -1}}, "weight_decay is 0 or larger"),
        ({"loss": {"max_disparity": 0}}, "max_disparity must be positive"),
        ({"loss": {"cross_entropy": -0.1}}, "cross_entropy is a weight from 0 up"),
        ({"averaging": {"kind": "median"}}, "'ema', 'swa' or 'none'"),
        ({"averaging": {"kind": "ema", "decay": 1}}, "decay"),
        ({"modle": {}}, "did you mean 'model'"),
        ({"model": {}}, "names no network"),
        ({"from_weights": "coex"}, "from_weights is 'coex'; expected true or false"),
    ],
)
def test_a_bad_recipe_is_explained(change, words):
    with pytest.raises(ConfigError, match=words):
        Recipe.from_dict({**TINY.to_dict(), **change})


def test_unknown_recipes_and_files(tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'sceneflow'"):
        load_recipe("scenflow")
    with pytest.raises(ConfigError, match="can't be read: No such file"):
        load_recipe(str(tmp_path / "mine.toml"))
    broken = tmp_path / "broken.toml"
    broken.write_text("[model\nname =")
    with pytest.raises(ConfigError, match="is no TOML"):
        load_recipe(str(broken))


def test_ones_own_recipe_file(tmp_path):
    own = tmp_path / "mine.toml"
    own.write_text(
        'about = "x"\n[model]\nname = "gcnet"\n[augmentation]\ncrop_height = 64\ncrop_width = 96\n'
        "[schedule]\nbatch = 1\nepochs = 2\n"
    )
    recipe = load_recipe(str(own))
    assert (recipe.name, recipe.model["name"], recipe.averaging) == ("mine", "gcnet", Averaging())
    assert replace(recipe, name="other").augmentation.crop_width == 96
