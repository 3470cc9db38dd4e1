"""What a training run is: network, crops, loss, optimiser, schedule, average. A page of TOML each."""

import inspect
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from stereokit.data.augmentation import Augmentation
from stereokit.data.synthetic import SyntheticScenes
from stereokit.errors import ConfigError
from stereokit.registry import suggest
from stereokit.training.fields import check_fields, check_types
from stereokit.training.optimisation import Optimisation
from stereokit.training.schedule import Schedule

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["Averaging", "Loss", "Optimisation", "Recipe", "Schedule", "list_recipes", "load_recipe", "with_length"]

_FOLDER = files("stereokit.training") / "recipes"


@dataclass(frozen=True, kw_only=True)
class Loss:
    """What is made small, and which ground truth counts.

    Attributes:
        kind: name of the distance between each output and the truth, or a table of its `name` and arguments.
        max_disparity: ground truth from there up does not count, in pixels; None counts all.
        cross_entropy: weight of `stereokit.losses.masked_cross_entropy` beside it, on the logits of the best head.

    Raises:
        ConfigError: a value of another type or out of range.

    >>> Loss(kind={"name": "smooth_l1"}).kind
    {'name': 'smooth_l1'}
    """

    kind: str | Mapping[str, Any] = "smooth_l1"
    max_disparity: float | None = None
    cross_entropy: float = 0.0

    def __post_init__(self) -> None:
        check_fields("loss", self)
        if not isinstance(self.kind, str) and not isinstance(self.kind.get("name"), str):
            raise ConfigError(f"loss: kind is {dict(self.kind)!r}; expected a name, or a table with a name in it")
        if self.max_disparity is not None and self.max_disparity <= 0:
            raise ConfigError(f"loss: max_disparity must be positive, got {self.max_disparity}")
        if self.cross_entropy < 0:
            raise ConfigError(f"loss: cross_entropy is a weight from 0 up, got {self.cross_entropy!r}")


@dataclass(frozen=True, kw_only=True)
class Averaging:
    """The average of the weights that is validated and saved in place of the last ones.

    Attributes:
        kind: "ema", an exponential moving average from the first step on; "swa", the plain mean of the weights after
            each step from `start` on; "none".
        decay: of "ema".
        start: of "swa", as progress from 0 to 1.
    """

    kind: Literal["ema", "swa", "none"] = "none"
    decay: float = 0.999
    start: float = 0.75

    def __post_init__(self) -> None:
        check_fields("averaging", self)
        if not (0 <= self.decay < 1 and 0 <= self.start < 1):
            raise ConfigError(f"averaging: decay and start lie from 0 to below 1; got {self.decay} and {self.start}")


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """All that decides about a training run, but for the data on disk.

    Attributes:
        name: of the recipe.
        model: name of the network and what differs from it, as `build_model` takes them.
        augmentation: of each pair; its crop is the size that is trained on.
        schedule: length, batch and learning rate.
        about: what it is for and where it is from.
        optimisation: optimiser, its learning rate and the largest gradient.
        loss: what is made small, and which ground truth counts.
        averaging: of the weights.
        scenes: settings of `SyntheticScenes`, if the recipe is for rendered scenes.
        data: what to give as --data, for messages.
        from_weights: it goes on from a trained network, and is refused without one.

    >>> recipe = load_recipe("sceneflow")
    >>> recipe.model["name"], recipe.schedule.epochs, recipe.averaging.kind
    ('coex', 10, 'swa')
    """

    name: str
    model: Mapping[str, Any]
    augmentation: Augmentation
    schedule: Schedule
    about: str = ""
    optimisation: Optimisation = field(default_factory=Optimisation)
    loss: Loss = field(default_factory=Loss)
    averaging: Averaging = field(default_factory=Averaging)
    scenes: Mapping[str, Any] | None = None
    data: str = ""
    from_weights: bool = False

    def __post_init__(self) -> None:
        what = f"recipe {self.name!r}"
        check_fields(what, self)
        if "name" not in self.model:
            raise ConfigError(f"{what}: its [model] names no network")
        check_types(f"{what}, [model]", self.model, {"name": str, "pretrained_backbone": bool})
        for key in ("seed", "textures"):
            if key in (self.scenes or {}):
                raise ConfigError(f"{what}, [scenes]: {key} belongs to a run (--{key}), not to a recipe")
        taken = inspect.signature(SyntheticScenes).parameters
        check_types(f"{what}, [scenes]", self.scenes or {}, {key: taken[key].annotation for key in taken})

    def to_dict(self) -> dict[str, Any]:
        """Plain values, as `from_dict` takes them; JSON keeps them."""
        return {key: _plain(value) for key, value in asdict(self).items()}

    def rendered_scenes(self, **settings: Any) -> SyntheticScenes:
        """The scenes of the recipe, as it renders them to train on.

        Args:
            settings: of `SyntheticScenes`, such as seed and textures; they go before the recipe's.

        Raises:
            ConfigError: the recipe is for files, or a setting is unknown or out of range.
            InputError: the textures can't be read.

        >>> load_recipe("synthetic").rendered_scenes(seed=3, size=(64, 128))[0].left.shape
        (64, 128, 3)
        """
        if self.scenes is None:
            raise ConfigError(f"recipe {self.name!r} renders no scenes: it trains on {self.data or 'files'}")
        try:
            return SyntheticScenes(**{**_with_tuples(self.scenes), **settings})
        except TypeError as error:
            raise ConfigError(f"recipe {self.name!r}, [scenes]: {error}") from error

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], name: str | None = None) -> "Recipe":
        """The recipe of plain values.

        Raises:
            ConfigError: an unknown or missing key, or a value out of range.
        """
        values = dict(values)
        name = name or values.get("name")
        values["name"] = name
        for key, section in _SECTIONS.items():
            if key in values:
                values[key] = _build(section, values[key], f"recipe {name!r}, [{key}]")
        return _build(cls, values, f"recipe {name!r}")


_SECTIONS: dict[str, type] = {
    "augmentation": Augmentation,
    "schedule": Schedule,
    "optimisation": Optimisation,
    "loss": Loss,
    "averaging": Averaging,
}


def list_recipes() -> list[str]:
    """The recipes that come with the library.

    >>> "sceneflow" in list_recipes()
    True
    """
    return sorted(file.name.removesuffix(".toml") for file in _FOLDER.iterdir() if file.name.endswith(".toml"))


def load_recipe(name_or_file: str) -> Recipe:
    """A recipe of the library by its name, or one's own from a TOML file.

    Raises:
        ConfigError: there is none of this name, the file can't be read, or it holds something else.
    """
    if name_or_file.endswith(".toml"):
        name, source = Path(name_or_file).stem, Path(name_or_file)
    elif name_or_file in list_recipes():
        name, source = name_or_file, _FOLDER / f"{name_or_file}.toml"  # type: ignore[assignment]
    else:
        hint = suggest(name_or_file, list_recipes())
        raise ConfigError(f"unknown recipe {name_or_file!r}; {hint}. One's own is a file that ends in .toml")
    try:
        values = tomllib.loads(source.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"recipe {name_or_file!r} can't be read: {error.strerror or error}") from error
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(f"recipe {name_or_file!r} is no TOML: {error}") from error
    return Recipe.from_dict(values, name)


def with_length(recipe: Recipe, *, steps: int | None = None, batch: int | None = None) -> Recipe:
    """The recipe with another number of steps, or another batch.

    >>> with_length(load_recipe("sceneflow"), steps=100).schedule.total_steps(35_454)
    100
    """
    schedule = recipe.schedule
    if steps is not None:
        schedule = schedule.of_steps(steps)
    if batch is not None:
        schedule = replace(schedule, batch=batch)
    return replace(recipe, schedule=schedule)


def _build(cls: type, values: Any, what: str) -> Any:
    if not isinstance(values, Mapping):
        raise ConfigError(f"{what}: expected a table of values, got {values!r}")
    known = [f.name for f in fields(cls)]
    for key in values:
        if key not in known:
            raise ConfigError(f"{what}: unknown key {key!r}; {suggest(key, known)}")
    check_types(what, values, {f.name: f.type for f in fields(cls)})
    try:
        return cls(**_with_tuples(values))
    except TypeError as error:
        raise ConfigError(f"{what}: {error}") from error


def _with_tuples(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in values.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(part) for key, part in value.items()}
    return [_plain(part) for part in value] if isinstance(value, Sequence) and not isinstance(value, str) else value
