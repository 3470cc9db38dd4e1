import json
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereokit.builder import build_model
from stereokit.errors import ConfigError
from stereokit.training import Averaging, Recipe, Schedule, list_recipes, load_recipe
from tests.training.tiny import TINY


@pytest.mark.parametrize("name", list_recipes())
def test_every_recipe_loads_and_survives_json(name):
    recipe = load_recipe(name)
    assert Recipe.from_dict(json.loads(json.dumps(recipe.to_dict()))) == recipe
    assert recipe.scenes or recipe.data
    options = {key: value for key, value in recipe.model.items() if key not in ("name", "pretrained_backbone")}
    assert build_model(recipe.model["name"], **options).auxiliary_weights


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


def test_steps_are_counted_from_epochs():
    assert load_recipe("sceneflow").schedule.total_steps(35_454) == -(-35_454 * 10 // 8)
    assert Schedule(batch=4, steps=7).total_steps(1) == 7


@given(
    st.floats(0, 1),
    st.floats(0, 1),
    st.lists(st.floats(0.01, 0.99), max_size=4),
    st.floats(0.01, 1),
    st.floats(0, 0.5),
)
def test_behind_the_warmup_the_rate_never_rises(a, b, milestones, factor, warmup):
    schedule = Schedule(batch=1, steps=10, milestones=tuple(milestones), factor=factor, warmup=warmup)
    early, late = sorted((a, b))
    if early >= warmup:
        assert schedule.learning_rate_factor(late) <= schedule.learning_rate_factor(early)
    assert 0 <= schedule.learning_rate_factor(a) <= 1


def test_the_warmup_rises_from_nothing_in_a_line():
    schedule = Schedule(batch=1, steps=10, warmup=0.2)
    assert [schedule.learning_rate_factor(p) for p in (0, 0.05, 0.1, 0.2, 0.9)] == pytest.approx([0, 0.25, 0.5, 1, 1])


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
        ({"optimisation": {"betas": 0.9}}, "betas are two numbers"),
        ({"optimisation": {"betas": [0.9, 1]}}, "betas are two numbers"),
        ({"loss": {"cross_entropy": -0.1}}, "cross_entropy is a weight from 0 up"),
        ({"averaging": {"kind": "median"}}, "'ema', 'swa' or 'none'"),
        ({"averaging": {"kind": "ema", "decay": 1}}, "decay"),
        ({"modle": {}}, "did you mean 'model'"),
        ({"model": {}}, "names no network"),
        ({"from_weights": "coex"}, "from_weights is true or false"),
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
