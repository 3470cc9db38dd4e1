"""A training run, from a recipe to a saved network."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer, seed_everything
from lightning.pytorch.callbacks import Callback

from stereokit.data.datasets.layout import images_in
from stereokit.errors import ConfigError
from stereokit.files import write_json
from stereokit.network import StereoNetwork
from stereokit.optimize import copy_state
from stereokit.runtime import provenance
from stereokit.runtime.provenance import commit, file_sha256, state_sha256, versions
from stereokit.training.averaging import AveragedWeights
from stereokit.training.best import BestNetwork
from stereokit.training.checkpoint import LastCheckpoint
from stereokit.training.data import StereoData, usual_workers
from stereokit.training.fields import is_number
from stereokit.training.machine import Machine
from stereokit.training.module import StereoTraining
from stereokit.training.opening import NetworkFrom, new_network, open_pairs, recipe_of_run
from stereokit.training.pictures import ValidationPictures
from stereokit.training.progress import ProgressBar
from stereokit.training.recipe import Recipe
from stereokit.training.resume import RunFolder
from stereokit.training.statistics import SharedBatchStatistics
from stereokit.training.trainer import build_trainer, fit, is_first_process

__all__ = ["Outcome", "train"]


@dataclass(frozen=True)
class Outcome:
    """What a run came to.

    Attributes:
        model: with the averaged weights, on the CPU, in eval mode; the network that was given, if one was.
        network: the folder that it is saved in.
        record: what `training.json` holds.
    """

    model: StereoNetwork
    network: Path
    record: Mapping[str, Any]


def train(
    recipe: Recipe,
    out: str | Path,
    *,
    data: Sequence[str] = (),
    validation: Sequence[str] = (),
    textures: str | Path | None = None,
    model: StereoNetwork | None = None,
    weights: str | None = None,
    network_from: NetworkFrom = "recipe",
    seed: int = 0,
    minutes: float | None = None,
    resume: bool = False,
    machine: Machine = Machine(),  # noqa: B008
    command: str | None = None,
) -> Outcome:
    """Trains a network and saves it.

    Everything goes into one folder: `run.json` (what was asked for), `checkpoints/last.ckpt`, `logs/` (CSV and
    TensorBoard), `pictures/` of validation pairs, `best/` (the network of the smallest mean bad-3 in validation) and in
    the end `network/`, both for `Predictor` and `from_pretrained`, with `training.json`.

    Killed at any moment and started again with `resume`, it goes on from the last checkpoint and comes to the same
    result as an unbroken run, to within floating point.

    Args:
        recipe: what to do, see `load_recipe`.
        out: the folder.
        data: data sets to train on, "KIND:ROOT", see `open_dataset`; without any, a recipe for rendered scenes renders.
        validation: data sets to validate on; without any, a recipe for rendered scenes renders some of another seed.
        textures: folder of photographs that rendered scenes use besides procedural textures.
        model: a network to go on from, in place of the recipe's own with random weights. It keeps its classes and
            hooks, and has the trained weights in the end; after an error, those that the run came to.
        weights: name of the weights of `model`, for the line that says what the run starts from.
        network_from: which network is trained where `model` is not the recipe's: with "recipe" it is refused, with
            "weights" it is trained as it is, and the record names it.
        seed: of weights, order, augmentation and scenes.
        minutes: wall-clock time from the first step to the end of the last validation, over all resumptions: the
            schedule is fitted into it. Time for the validation is kept by what the one before took, or else by what
            the steps take; it is half of the minutes at most. The steps of the recipe are still the most.
        resume: go on with the run that the folder holds; if it holds none yet, start it.
        machine: what to train on, and how often to write down and to validate.
        command: the command line, for the record.

    Raises:
        InputError: data that can't be used or has nothing to learn from, or a folder that holds a run already.
        ConfigError: settings that do not go together, that the machine does not have, other ones than those of the
            run to resume, or a model that is not the recipe's.
        CheckpointError: the checkpoint can't be read.
        TrainingError: losses stay infinite or NaN.

    Warns:
        UserWarning: most of the ground truth does not count, see `stereokit.training.supervision`.
    """
    # open
    _check_numbers(seed, minutes)
    folder = RunFolder(Path(out))
    recipe = recipe_of_run(recipe, model, network_from)
    pairs = open_pairs(recipe, data, validation, textures, seed)
    steps = recipe.schedule.total_steps(pairs.training.pairs)
    asked = _asked(recipe, seed, data, textures, validation, model)
    # now: in hours the code beside it may be another
    circumstances = {"command": command, "commit": commit(), "versions": versions(), "machine": provenance.machine()}
    goes_on = resume and folder.last.is_file()
    if goes_on:
        folder.check_checkpoint(steps, minutes)

    # build
    seed_everything(seed, verbose=False)
    network = new_network(recipe) if model is None else model
    training = StereoTraining(
        network, recipe, steps=steps, minutes=minutes, validation=tuple(pairs.validation), compile=machine.compile
    )
    training.model.train()
    save = partial(_save, training, asked, circumstances)
    validate_every = min(machine.validate_every, steps)
    checkpoint = LastCheckpoint(folder.last, machine.checkpoint_every, validate_every if pairs.validation else None)
    callbacks = [*_callbacks(training, folder, save, goes_on=goes_on), checkpoint]
    trainer = build_trainer(machine, folder.path, training, callbacks, validate_every=validate_every)
    loaders = StereoData(
        pairs.training,
        batch=recipe.schedule.batch,
        steps=steps,
        validation=pairs.validation,
        workers=usual_workers(trainer.num_devices) if machine.workers is None else machine.workers,
    )

    # fit
    if is_first_process():
        folder.prepare(asked, circumstances, resume=resume)
        print(f"goes on with the run in {out}" if goes_on else _start(recipe, model, weights))
    _fit(trainer, training, loaders, folder, network, goes_on=goes_on)

    # save
    record = save(folder.network, network.eval())
    if is_first_process():
        checkpoint.finish()
    return Outcome(network, folder.network, record)


def _asked(
    recipe: Recipe,
    seed: int,
    data: Sequence[str],
    textures: str | Path | None,
    validation: Sequence[str],
    model: StereoNetwork | None,
) -> dict[str, Any]:
    """What a run is, whatever it runs on: what a resumption has to be asked for again."""
    return {
        "recipe": recipe.to_dict(),
        "seed": seed,
        "data": list(data),
        # by content: the folder may lie elsewhere tomorrow, and weights name it to those who do not have it
        "textures": None if textures is None else {p.name: file_sha256(p) for p in images_in(Path(textures))},
        "validate": list(validation),
        "start": None if model is None else state_sha256(model.state_dict()),
    }


def _callbacks(
    training: StereoTraining, folder: RunFolder, save: Callable[[Path, StereoNetwork], object], *, goes_on: bool
) -> list[Callback]:
    """All but the checkpoint, which Lightning puts last anyway."""
    averaging = training.recipe.averaging
    averaged = None if averaging.kind == "none" else AveragedWeights(averaging, lambda: training.progress)
    # the average first: its copy is not meant to see the network's conversion for several GPUs
    callbacks: list[Callback] = [] if averaged is None else [averaged]
    callbacks += [ProgressBar(), SharedBatchStatistics()]
    if training.validation:
        callbacks += [
            ValidationPictures(folder.path / "pictures", training.validation),
            BestNetwork(
                lambda: save(folder.best, training.model if averaged is None else averaged.network),
                folder.best_bad_3() if goes_on else None,
            ),
        ]
    return callbacks


def _fit(
    trainer: Trainer,
    training: StereoTraining,
    loaders: StereoData,
    folder: RunFolder,
    network: StereoNetwork,
    *,
    goes_on: bool,
) -> None:
    """Trains, and gives the network what its twin came to, in the end or up to an error."""
    try:
        fit(trainer, training, loaders, folder.last if goes_on else None)
    except BaseException as error:
        if isinstance(error, Exception) and is_first_process():
            folder.note_end(error)
        # such as a GPU that does not answer any more, which is what is to be told
        with suppress(RuntimeError):
            copy_state(training.model.cpu(), network.cpu())
        raise
    copy_state(training.model.cpu(), network.cpu())


def _save(
    training: StereoTraining,
    asked: Mapping[str, Any],
    circumstances: Mapping[str, Any],
    place: Path,
    trained: StereoNetwork,
) -> dict[str, Any]:
    """Writes a network and its record, and gives the record."""
    record = {
        **asked,
        "steps": training.global_step,
        "pairs_seen": training.pairs_seen,
        "broken_steps": training.broken_steps,
        "seconds": round(training.seconds, 1),
        "weights_sha256": state_sha256(trained.state_dict()),
        "validation": training.errors,
        **circumstances,
    }
    if is_first_process():
        trained.save_pretrained(place)
        write_json(place / "training.json", record, overwrite=True)
    return record


def _start(recipe: Recipe, model: StereoNetwork | None, weights: str | None) -> str:
    """What a run starts from, in words."""
    if model is not None:
        return f"starts from the weights {weights or 'of the given network'}"
    encoder = ", the encoder from ImageNet's" if recipe.model.get("pretrained_backbone") else ""
    return f"starts from random weights{encoder}"


def _check_numbers(seed: int, minutes: float | None) -> None:
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 2**32:
        raise ConfigError(f"seed is {seed!r}; expected a whole number from 0 to {2**32 - 1}")
    if minutes is not None and not (is_number(minutes) and minutes > 0):
        raise ConfigError(f"minutes is {minutes!r}; expected a number above 0")
