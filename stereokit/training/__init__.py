"""Training: recipes, and Lightning around the library's networks, data, loss and metrics (extra "train")."""

from typing import TYPE_CHECKING, Any

from stereokit.errors import ConfigError
from stereokit.training.machine import Machine
from stereokit.training.optimisation import Optimisation
from stereokit.training.recipe import Averaging, Loss, Recipe, list_recipes, load_recipe, with_length
from stereokit.training.samples import Batch, ResumableLoader, TrainingSamples
from stereokit.training.schedule import Schedule

if TYPE_CHECKING:
    from stereokit.training.module import StereoTraining, TrainingError
    from stereokit.training.run import Outcome, train

__all__ = [
    "Averaging",
    "Batch",
    "Loss",
    "Machine",
    "Optimisation",
    "Outcome",
    "Recipe",
    "ResumableLoader",
    "Schedule",
    "StereoTraining",
    "TrainingError",
    "TrainingSamples",
    "list_recipes",
    "load_recipe",
    "train",
    "with_length",
]

_NEED_LIGHTNING = {
    "Outcome": "run",
    "StereoTraining": "module",
    "TrainingError": "module",
    "train": "run",
}


def __getattr__(name: str) -> Any:
    if name not in _NEED_LIGHTNING:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    try:
        return getattr(import_module(f"{__name__}.{_NEED_LIGHTNING[name]}"), name)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ("lightning", "tensorboard"):
            raise
        raise ConfigError("training needs more packages: pip install 'stereokit[train]'") from error
