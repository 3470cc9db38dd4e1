"""What a run trains and validates on, and the network that it begins with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

from stereokit.builder import build_model
from stereokit.data.datasets import open_dataset
from stereokit.data.datasets.dataset import StereoDataset, StereoSample
from stereokit.errors import ConfigError, InputError
from stereokit.network import StereoNetwork
from stereokit.training.recipe import Recipe
from stereokit.training.samples import TrainingSamples
from stereokit.training.supervision import check_supervision

__all__ = ["NetworkFrom", "Pairs", "new_network", "open_pairs", "recipe_of_run"]

VALIDATION_SEED = 1_000_003
VALIDATION_SCENES = 16
SCENES_LOOKED_AT = 2

NetworkFrom = Literal["recipe", "weights"]


@dataclass(frozen=True)
class Pairs:
    """What to train on, and the sets to validate on by name."""

    training: TrainingSamples
    validation: Mapping[str, Sequence[StereoSample]]


def open_pairs(
    recipe: Recipe, data: Sequence[str], validation: Sequence[str], textures: str | Path | None, seed: int
) -> Pairs:
    """Opens the data sets of a run, or gets its scenes ready to be rendered.

    Raises:
        InputError: there is nothing to train on, a data set can't be opened, or its ground truth can't be used.
        ConfigError: textures for a run that renders nothing, or settings of scenes that can't be used.
    """
    rendered = not data and recipe.scenes is not None
    if not data and not rendered:
        raise InputError(f"recipe {recipe.name!r} trains on files: give --data {recipe.data or 'KIND:ROOT'}")
    if textures is not None and not rendered:
        raise ConfigError("textures are for rendered scenes; this run reads its pairs from files")
    datasets: dict[str, Any] = {spec: _open_known(spec) for spec in data}
    sets: dict[str, Any] = {}
    for spec in validation:
        name = spec.partition(":")[0].partition(",")[0]
        sets[name if name not in sets else f"{name}_{len(sets)}"] = _open_known(spec)
    if rendered:
        datasets["rendered scenes"] = recipe.rendered_scenes(seed=seed, textures=textures)
        if not sets:
            sets["synthetic"] = recipe.rendered_scenes(
                seed=seed + VALIDATION_SEED, textures=textures, count=VALIDATION_SCENES
            )
    samples = TrainingSamples([datasets[name] for name in data or datasets], recipe.augmentation, seed=seed)
    looked_at = {"most_pairs": SCENES_LOOKED_AT} if rendered else {}
    for name, dataset in datasets.items():
        check_supervision(name, dataset, max_disparity=recipe.loss.max_disparity, **looked_at)
    return Pairs(samples, sets)


def recipe_of_run(recipe: Recipe, model: StereoNetwork | None, network_from: NetworkFrom) -> Recipe:
    """The recipe, with the network that is trained.

    Args:
        recipe: what was asked for.
        model: the network to go on from, if there is one.
        network_from: what decides about the network, see `train`.

    Raises:
        ConfigError: a network to go on from is missing, or is not what the recipe says.
    """
    if network_from not in get_args(NetworkFrom):
        raise ConfigError(f"network_from is {network_from!r}; use 'recipe' or 'weights'")
    if model is None:
        if network_from == "weights":
            raise ConfigError("--network-from weights has no effect without --weights; leave it out, or give both")
        if recipe.from_weights:
            raise ConfigError(
                f"recipe {recipe.name!r} goes on from a trained {recipe.model['name']}: give --weights with a saved "
                "network, a published checkpoint or a name of stereokit list weights; from_weights = false in a recipe "
                "of one's own trains from random weights"
            )
        return recipe
    if network_from == "weights":
        return replace(recipe, model=dict(model.config))
    _check_network(recipe, model)
    return recipe


def new_network(recipe: Recipe) -> StereoNetwork:
    """The recipe's network with random weights.

    Raises:
        ConfigError: it can't be built.
    """
    options = dict(recipe.model)
    return build_model(options.pop("name"), **options)


def _open_known(spec: str) -> StereoDataset:
    """A data set with ground truth for each pair."""
    dataset = open_dataset(spec)
    unknown = [entry.name for entry in dataset.entries if entry.disparity is None]
    if unknown:
        raise InputError(
            f"{len(unknown)} of {len(dataset)} pairs of {spec!r} have no ground truth to train on or to validate on, "
            f"{unknown[0]!r} the first of them"
        )
    return dataset


def _check_network(recipe: Recipe, model: StereoNetwork) -> None:
    """Sees that a network to go on from is what the recipe says."""
    overrides = dict(recipe.model)
    name = overrides.pop("name")
    overrides.pop("pretrained_backbone", None)
    given = dict(model.config)
    wanted = dict(build_model(model.config, **overrides).config) if given["name"] == name else {"name": name}
    differing = [key for key, value in wanted.items() if given[key] != value]
    if differing:
        raise ConfigError(
            f"recipe {recipe.name!r} is for {_slots(wanted, differing)}, and the network to go on from has "
            f"{_slots(given, differing)}; give --network-from weights to train it as it is, or a recipe of one's own "
            "with another [model]"
        )


def _slots(config: Mapping[str, Any], keys: Sequence[str]) -> str:
    return ", ".join(f"{key} {config[key]!r}" for key in keys)
