"""What a training run is: network, crops, loss, optimiser, schedule, average. A page of TOML each."""

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args

from stereokit.data.augmentation import Augmentation
from stereokit.data.synthetic import SyntheticScenes
from stereokit.errors import ConfigError
from stereokit.registry import suggest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

__all__ = ["Averaging", "Loss", "Optimisation", "Recipe", "Schedule", "list_recipes", "load_recipe"]

_FOLDER = files("stereokit.training") / "recipes"


@dataclass(frozen=True, kw_only=True)
class Loss:
    """`stereokit.losses.stereo_loss`, and which ground truth counts.

    Attributes:
        max_disparity: ground truth from there up does not count, in pixels; None counts all.
        cross_entropy: weight of `stereokit.losses.masked_cross_entropy` beside it, on the logits of the best head.
    """

    max_disparity: float | None = None
    cross_entropy: float = 0.0

    def __post_init__(self) -> None:
        if isinstance(self.cross_entropy, bool) or not 0 <= self.cross_entropy < math.inf:
            raise ConfigError(f"loss: cross_entropy is a weight from 0 up, got {self.cross_entropy!r}")


@dataclass(frozen=True, kw_only=True)
class Optimisation:
    """Adam.

    Attributes:
        learning_rate: before the schedule.
        betas: decay of the averages of the gradient and of its square.
        gradient_clip: largest norm of the gradient of all parameters; None for any.
    """

    learning_rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.999)
    gradient_clip: float | None = None

    def __post_init__(self) -> None:
        clip = math.inf if self.gradient_clip is None else self.gradient_clip
        _check_positive("optimisation", learning_rate=self.learning_rate, gradient_clip=clip)
        pair = self.betas if isinstance(self.betas, list | tuple) else ()
        if len(pair) != 2 or not all(isinstance(beta, int | float) and 0 <= beta < 1 for beta in pair):
            raise ConfigError(f"optimisation: betas are two numbers from 0 to below 1; got {self.betas!r}")


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """How long training lasts, and what the learning rate does meanwhile.

    The learning rate is a function of progress, from 0 at the start to 1 at the end, so that the same schedule fits
    a number of steps, a number of epochs or a number of minutes.

    Attributes:
        batch: pairs a step, over all processes.
        steps: of the optimiser; or
        epochs: passes over the data.
        warmup: part of the run in which the learning rate rises from 0.
        milestones: progress at which the learning rate is multiplied by `factor`; where `epochs` is given, in epochs.
        factor: see `milestones`.

    Raises:
        ConfigError: both or neither of steps and epochs, or values out of range.

    >>> schedule = Schedule(batch=8, epochs=10, milestones=(7,), factor=0.1)
    >>> [round(schedule.learning_rate_factor(progress), 3) for progress in (0.0, 0.69, 0.7, 0.99)]
    [1.0, 1.0, 0.1, 0.1]
    """

    batch: int
    steps: int | None = None
    epochs: int | None = None
    warmup: float = 0.0
    milestones: tuple[float, ...] = ()
    factor: float = 0.1

    def __post_init__(self) -> None:
        if (self.steps is None) == (self.epochs is None):
            raise ConfigError(f"schedule: expected steps or epochs, got steps={self.steps} and epochs={self.epochs}")
        length = self.steps if self.epochs is None else self.epochs
        _check_positive("schedule", length=length, batch=self.batch, factor=self.factor)
        if not 0 <= self.warmup < 1:
            raise ConfigError(f"schedule: warmup is a part of the run, from 0 to below 1; got {self.warmup}")
        end = self.epochs or 1
        if any(not 0 < milestone < end for milestone in self.milestones):
            unit = "epochs" if self.epochs else "parts of the run"
            raise ConfigError(f"schedule: milestones are {unit} between 0 and {end}; got {list(self.milestones)}")

    def learning_rate_factor(self, progress: float) -> float:
        """What the learning rate is multiplied by at this progress in [0, 1]."""
        end = self.epochs or 1
        passed = sum(progress >= milestone / end for milestone in self.milestones)
        rising = min(1.0, progress / self.warmup) if self.warmup else 1.0
        return rising * self.factor**passed

    def total_steps(self, pairs: int) -> int:
        """Steps of the whole run over a data set of so many pairs."""
        return self.steps or math.ceil((self.epochs or 0) * pairs / self.batch)


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
        if self.kind not in get_args(Literal["ema", "swa", "none"]):
            raise ConfigError(f"averaging: unknown kind {self.kind!r}; use 'ema', 'swa' or 'none'")
        if not (0 <= self.decay < 1 and 0 <= self.start < 1):
            raise ConfigError(f"averaging: decay and start lie from 0 to below 1; got {self.decay} and {self.start}")


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """All that a training run hangs on, but for the data on disk.

    Attributes:
        name: of the recipe.
        model: name of the network and what differs from it, as `build_model` takes them.
        augmentation: of each pair; its crop is the size that is trained on.
        schedule: length, batch and learning rate.
        about: what it is for and where it is from.
        optimisation: Adam.
        loss: which ground truth counts.
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
        if "name" not in self.model:
            raise ConfigError(f"recipe {self.name!r}: its [model] names no network")
        if not isinstance(self.from_weights, bool):
            raise ConfigError(f"recipe {self.name!r}: from_weights is true or false, got {self.from_weights!r}")
        for key in ("seed", "textures"):
            if key in (self.scenes or {}):
                raise ConfigError(f"recipe {self.name!r}, [scenes]: {key} belongs to a run (--{key}), not to a recipe")

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

    >>> list_recipes()
    ['dispnetc-sceneflow', 'kitti-finetune', 'psmnet-kitti', 'psmnet-sceneflow', 'sceneflow', 'stereonet-sceneflow', \
'synthetic', 'synthetic-finetune']
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


def _build(cls: type, values: Any, what: str) -> Any:
    if not isinstance(values, Mapping):
        raise ConfigError(f"{what}: expected a table of values, got {values!r}")
    known = [f.name for f in fields(cls)]
    for key in values:
        if key not in known:
            raise ConfigError(f"{what}: unknown key {key!r}; {suggest(key, known)}")
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


def _check_positive(section: str, **values: float | None) -> None:
    for key, value in values.items():
        if value is None or isinstance(value, bool) or not value > 0:
            raise ConfigError(f"{section}: {key} must be positive, got {value!r}")
