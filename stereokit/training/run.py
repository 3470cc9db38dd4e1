"""A training run, from a recipe to a saved network."""

import json
import logging
import signal
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import LightningModule, Trainer, seed_everything
from lightning.pytorch.callbacks import Callback, Checkpoint, TQDMProgressBar
from lightning.pytorch.callbacks.progress.tqdm_progress import Tqdm
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from stereokit.builder import build_model
from stereokit.data.datasets import open_dataset
from stereokit.data.datasets.dataset import StereoDataset, StereoSample
from stereokit.data.datasets.layout import images_in
from stereokit.errors import CheckpointError, ConfigError, InputError, StereoKitError
from stereokit.files import atomic_path, make_folder
from stereokit.network import StereoNetwork
from stereokit.runtime.memory import running_out_as
from stereokit.runtime.processor import cpu_has
from stereokit.runtime.provenance import commit, file_sha256, machine, state_sha256, versions
from stereokit.training.averaging import AveragedWeights
from stereokit.training.best import BestNetwork
from stereokit.training.data import StereoData, usual_workers
from stereokit.training.module import StereoTraining
from stereokit.training.pictures import ValidationPictures
from stereokit.training.recipe import Recipe
from stereokit.training.samples import TrainingSamples
from stereokit.training.statistics import SharedBatchStatistics

__all__ = ["Outcome", "train"]

VALIDATION_SEED = 1_000_003
VALIDATION_SCENES = 16

TOO_MUCH_MEMORY = "a step takes more memory than there is; use a smaller --batch, or crop_height and crop_width,"


@dataclass(frozen=True)
class Outcome:
    """What a run came to.

    Attributes:
        model: with the averaged weights, on the CPU, in eval mode.
        network: the folder that it is saved in.
        record: what `training.json` holds.
    """

    model: StereoNetwork
    network: Path
    record: Mapping[str, Any]


class _ProgressBar(TQDMProgressBar):
    """Shows steps of the whole run; where minutes end it, it promises no number of steps and shows minutes."""

    @property
    def total_train_batches(self) -> int | float:
        return cast(StereoTraining, self.trainer.lightning_module).steps

    def init_train_tqdm(self) -> Tqdm:
        bar = super().init_train_tqdm()
        if cast(StereoTraining, self.trainer.lightning_module).minutes is not None:
            bar.bar_format = "{desc}{n_fmt} [{elapsed}, {rate_noinv_fmt}{postfix}]"
        # Lightning sets these where an epoch starts; a run that is resumed is within one
        bar.total, bar.initial = self.total_train_batches, self.trainer.global_step
        return bar

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        training = cast(StereoTraining, pl_module)
        metrics = super().get_metrics(trainer, pl_module)
        metrics.pop("v_num", None)
        if training.minutes is None:
            return metrics
        return {"minutes": f"{training.seconds / 60:.1f} of {training.minutes:g}", **metrics}


class _LastCheckpoint(Checkpoint):
    """Writes the state of the run to one file every so many steps, and behind the last one to a file of its own.

    `train` puts that one in the other's place when the network is saved: a run that is killed before still has its end
    to come. A step that is validated is written behind its validation, which a run that is killed in it repeats.
    """

    def __init__(self, path: Path, every: int, validate_every: int | None) -> None:
        self.path = path
        self.end, self.part = (path.with_name(name) for name in ("end.ckpt", "part.ckpt"))
        self.every = every
        self.validate_every = validate_every

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if trainer.should_stop:
            trainer.save_checkpoint(self.end)
        elif self.validate_every is None or trainer.global_step % self.validate_every:
            self._write(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if not trainer.should_stop:
            self._write(trainer)

    def _write(self, trainer: Trainer) -> None:
        if trainer.global_step % self.every:
            return
        # Lightning's own temporary file lies elsewhere, and a move from there is no single step
        trainer.save_checkpoint(self.part)
        if trainer.is_global_zero:
            self.part.replace(self.path)


def train(
    recipe: Recipe,
    out: str | Path,
    *,
    data: Sequence[str] = (),
    validation: Sequence[str] = (),
    textures: str | Path | None = None,
    model: StereoNetwork | None = None,
    weights: str | None = None,
    seed: int = 0,
    minutes: float | None = None,
    resume: bool = False,
    accelerator: str = "auto",
    devices: int | str = "auto",
    nodes: int = 1,
    precision: str = "32",
    compile: bool = False,
    workers: int | None = None,
    checkpoint_every: int = 200,
    validate_every: int = 1000,
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
        model: a network to go on from, in place of the recipe's own with random weights.
        weights: name of the weights of `model`, for the line that says what the run starts from.
        seed: of weights, order, augmentation and scenes.
        minutes: wall-clock time from the first step to the end of the last validation, over all resumptions: the
            schedule is fitted into it. Time for the validation is kept by what the one before took, or else by what
            the steps take; it is half of the minutes at most. The steps of the recipe are still the most.
        resume: go on with the run that the folder holds; if it holds none yet, start it.
        accelerator: "auto", "cpu", "gpu", .., as in `lightning.pytorch.Trainer`.
        devices: how many on each machine, or "auto".
        nodes: how many machines.
        precision: "32", "bf16-mixed", "16-mixed", .., as in `lightning.pytorch.Trainer`.
        compile: train through `torch.compile`.
        workers: processes that read and augment, for each training process.
        checkpoint_every: steps between checkpoints.
        validate_every: steps between validations.
        command: the command line, for the record.

    Raises:
        InputError: data that can't be used, or a folder that holds a run already.
        ConfigError: settings that do not go together, that the machine does not have, other ones than those of the
            run to resume, or a model that is not the recipe's.
        CheckpointError: the checkpoint can't be read.
        TrainingError: losses stay infinite or NaN.
    """
    out = Path(out)
    _check_counts(workers=workers, checkpoint_every=checkpoint_every, validate_every=validate_every)
    if minutes is not None and not minutes > 0:
        raise ConfigError(f"minutes is {minutes}; expected more than 0")
    if recipe.from_weights and model is None:
        raise ConfigError(
            f"recipe {recipe.name!r} goes on from a trained {recipe.model['name']}: give --weights with a saved "
            "network, a published checkpoint or a name of stereokit list weights; from_weights = false in a recipe of "
            "one's own trains from random weights"
        )
    if model is not None:
        _check_model(recipe, model)
    samples, validation_sets = _open(recipe, data, validation, textures, seed)
    steps = recipe.schedule.total_steps(samples.pairs)
    asked = {
        "recipe": recipe.to_dict(),
        "seed": seed,
        "data": list(data),
        # by content: the folder may lie elsewhere tomorrow, and weights name it to those who do not have it
        "textures": None if textures is None else {p.name: file_sha256(p) for p in images_in(Path(textures))},
        "validate": list(validation),
        "start": None if model is None else state_sha256(model.state_dict()),
    }
    # now: in hours the code beside it may be another
    circumstances = _circumstances(command)
    last = out / "checkpoints" / "last.ckpt"
    goes_on = resume and last.is_file()
    if goes_on:
        _check_checkpoint(last, steps, minutes)

    seed_everything(seed, verbose=False)
    network = _new_network(recipe) if model is None else model.train()
    training = StereoTraining(
        network, recipe, steps=steps, minutes=minutes, validation=tuple(validation_sets), compile=compile
    )
    validate_every = min(validate_every, steps)
    checkpoint = _LastCheckpoint(last, checkpoint_every, validate_every if validation_sets else None)
    # ahead of the network's conversion for several GPUs, which its copy is not meant to see
    averaged = None if recipe.averaging.kind == "none" else AveragedWeights(recipe.averaging, lambda: training.progress)
    callbacks: list[Callback] = [] if averaged is None else [averaged]
    callbacks += [_ProgressBar(), checkpoint, SharedBatchStatistics()]

    def save(folder: Path, trained: StereoNetwork) -> dict[str, Any]:
        record = {
            **asked,
            "steps": trainer.global_step,
            "pairs_seen": training.pairs_seen,
            "broken_steps": training.broken_steps,
            "seconds": round(training.seconds, 1),
            "weights_sha256": state_sha256(trained.state_dict()),
            "validation": training.errors,
            **circumstances,
        }
        if is_first_process():
            trained.save_pretrained(folder)
            _write_json(folder / "training.json", record)
        return record

    if validation_sets:
        callbacks += [
            ValidationPictures(out / "pictures", tuple(validation_sets)),
            BestNetwork(
                lambda: save(out / "best", network if averaged is None else averaged.network),
                _best_bad_3(out) if goes_on else None,
            ),
        ]
    try:
        with _without_noise():
            trainer = Trainer(
                accelerator=accelerator,
                devices=devices,
                num_nodes=nodes,
                precision=precision,  # type: ignore[arg-type]
                max_steps=steps,
                max_epochs=1,
                gradient_clip_val=recipe.optimisation.gradient_clip,
                val_check_interval=validate_every,
                limit_val_batches=None if validation_sets else 0,
                check_val_every_n_epoch=None,
                num_sanity_val_steps=0,
                use_distributed_sampler=False,
                log_every_n_steps=min(20, steps),
                callbacks=callbacks,
                logger=[CSVLogger(out / "logs", "csv"), TensorBoardLogger(out / "logs", "tensorboard")],
                default_root_dir=out,
                enable_model_summary=False,
            )
    except (MisconfigurationException, ValueError, ImportError) as error:
        raise ConfigError(
            f"this machine does not train on accelerator {accelerator!r}, devices {devices!r} with precision "
            f"{precision!r}: {' '.join(str(error).split())}"
        ) from error
    if trainer.strategy.root_device.type == "cpu" and precision.startswith("bf16") and not cpu_has(torch.bfloat16):
        warnings.warn(
            f"this processor has no instructions for bfloat16, so that precision {precision!r} is slower here than "
            "the default of 32",
            stacklevel=2,
        )
    if is_first_process():
        _prepare_folder(out, asked, circumstances, resume=resume)
        if goes_on:
            print(f"goes on with the run in {out}")
        elif model is not None:
            print(f"starts from the weights {weights or 'of the given network'}")
        else:
            encoder = ", the encoder from ImageNet's" if recipe.model.get("pretrained_backbone") else ""
            print(f"starts from random weights{encoder}")
    loaders = StereoData(
        samples,
        batch=recipe.schedule.batch,
        steps=steps,
        validation=validation_sets,
        workers=usual_workers(trainer.num_devices) if workers is None else workers,
    )
    interruption = signal.getsignal(signal.SIGINT)
    try:
        with _without_noise(), _in_one_line(), running_out_as(f"{recipe.name}: {TOO_MUCH_MEMORY}"):
            trainer.fit(training, loaders, ckpt_path=str(last) if goes_on else None, weights_only=True)
    except Exception as error:
        if is_first_process():
            ended_by = str(error) if isinstance(error, StereoKitError) else f"{type(error).__name__}: {error}"
            # such as a full disk, which is what is to be told
            with suppress(StereoKitError):
                _write_json(out / "run.json", {**_read_json(out / "run.json"), "ended_by": ended_by})
        raise
    except SystemExit as error:
        # what Lightning makes of Ctrl-C
        if isinstance(error.__context__, KeyboardInterrupt):
            # which it has switched off, for good
            signal.signal(signal.SIGINT, interruption)
            raise KeyboardInterrupt from None
        raise
    network.cpu().eval()
    record = save(out / "network", network)
    if is_first_process():
        checkpoint.end.replace(last)
        checkpoint.part.unlink(missing_ok=True)
    return Outcome(network, out / "network", record)


@contextmanager
def _without_noise() -> Iterator[None]:
    """Leaves out what Lightning says of its own insides, of products, and of what was meant so."""
    logger = logging.getLogger("lightning.pytorch")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            # a CPU's few cores are shared between network and loaders on purpose
            warnings.filterwarnings("ignore", message=".*does not have many workers")
            warnings.filterwarnings("ignore", message=".*LeafSpec.*is deprecated")
            # the errors are those of all processes already, and of 1 x 1 kernels all strides are right
            warnings.filterwarnings("ignore", message="It is recommended to use `self.log")
            warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")
            warnings.filterwarnings("ignore", message="Be aware that when using `ckpt_path`")
            yield
    finally:
        logger.setLevel(level)


@contextmanager
def _in_one_line() -> Iterator[None]:
    """Errors of a loader's process without the traceback that comes along as text."""
    try:
        yield
    except StereoKitError as error:
        _, traceback, message = str(error).rpartition(f"{type(error).__module__}.{type(error).__qualname__}: ")
        if not traceback:
            raise
        raise type(error)(message.strip()) from None


def _open(
    recipe: Recipe, data: Sequence[str], validation: Sequence[str], textures: str | Path | None, seed: int
) -> tuple[TrainingSamples, dict[str, Sequence[StereoSample]]]:
    """What to train on, and what to validate on."""
    rendered = not data and recipe.scenes is not None
    if not data and not rendered:
        raise InputError(f"recipe {recipe.name!r} trains on files: give --data {recipe.data or 'KIND:ROOT'}")
    if textures is not None and not rendered:
        raise ConfigError("textures are for rendered scenes; this run reads its pairs from files")
    datasets: list[Any] = [_open_known(spec) for spec in data]
    sets: dict[str, Any] = {}
    for spec in validation:
        name = spec.partition(":")[0].partition(",")[0]
        sets[name if name not in sets else f"{name}_{len(sets)}"] = _open_known(spec)
    if rendered:
        datasets = [recipe.rendered_scenes(seed=seed, textures=textures)]
        if not sets:
            sets["synthetic"] = recipe.rendered_scenes(
                seed=seed + VALIDATION_SEED, textures=textures, count=VALIDATION_SCENES
            )
    return TrainingSamples(datasets, recipe.augmentation, seed=seed), sets


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


def _check_model(recipe: Recipe, model: StereoNetwork) -> None:
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
            f"{_slots(given, differing)}; a recipe of one's own says otherwise in [model]"
        )


def _slots(config: Mapping[str, Any], keys: Sequence[str]) -> str:
    return ", ".join(f"{key} {config[key]!r}" for key in keys)


def _new_network(recipe: Recipe) -> StereoNetwork:
    options = dict(recipe.model)
    return build_model(options.pop("name"), **options)


def _prepare_folder(out: Path, asked: dict[str, Any], circumstances: Mapping[str, Any], *, resume: bool) -> None:
    """Makes the folder of a new run, or sees that the one there is of the same run."""
    record = out / "run.json"
    if record.exists() and resume:
        before = _read_json(record)
        _check_same_run(out, before, asked)
        if before.pop("ended_by", None) is not None:
            _write_json(record, before)
        return
    if record.exists() and not _failed_at_once(out, _read_json(record)):
        raise InputError(f"{str(out)!r} holds a run already; go on with it by --resume, or choose another --out")
    if not record.exists() and out.exists() and any(out.iterdir()):
        raise InputError(f"the folder {str(out)!r} is not empty and holds no run; choose another --out")
    make_folder(out / "checkpoints")
    _write_json(record, {**asked, **circumstances})


def _failed_at_once(out: Path, run: Mapping[str, Any]) -> bool:
    """Whether an error ended a run before there was anything to lose."""
    left = (*out.glob("checkpoints/*"), *out.glob("best"), *out.glob("network"))
    return "ended_by" in run and not left


def _check_same_run(out: Path, before: Mapping[str, Any], asked: dict[str, Any]) -> None:
    """Sees that what is asked for is the run that the folder holds."""
    runs = before, json.loads(json.dumps(asked))
    # milestones stay the same epochs where there are more of these, or the same parts of the run
    differing = min((_differing(*(_settled(run, parts) for run in runs)) for parts in (True, False)), key=len)
    for key, (value, wanted) in differing.items():
        if isinstance(value, Mapping) and isinstance(wanted, Mapping):
            value, wanted = _without_common(value, wanted), _without_common(wanted, value)
        raise ConfigError(
            f"{str(out)!r} was started with {key} {_brief(value)}, not {_brief(wanted)}; resume it with the same, or "
            "choose another --out"
        )


def _without_common(values: Mapping[str, Any], others: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key not in others or others[key] != value}


def _brief(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]} .."


def _check_checkpoint(path: Path, steps: int, minutes: float | None) -> None:
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # the reader of a damaged file may stumble over anything
        raise CheckpointError(f"the checkpoint {str(path)!r} can't be read: {error}") from error
    if not isinstance(checkpoint, dict) or "stereokit" not in checkpoint:
        raise CheckpointError(f"{str(path)!r} is no checkpoint of stereokit train")
    done, ended_by = checkpoint["global_step"], checkpoint["stereokit"].get("ended_by_minutes")
    if done >= steps or (minutes is not None and ended_by is not None and minutes <= ended_by):
        length = f"{steps} steps" if done >= steps else f"{minutes:g} minutes"
        raise ConfigError(
            f"the run in {str(path.parents[1])!r} is finished: it is at step {done}, and {length} were asked for; "
            "a larger --steps or --minutes makes it longer"
        )


def _settled(run: Mapping[str, Any], in_parts: bool) -> dict[str, Any]:
    """What can't change between the start of a run and its resumption: all but its length."""
    # with the defaults of what a run before knew nothing of
    recipe = Recipe.from_dict(run["recipe"]).to_dict()
    schedule = dict(recipe.pop("schedule"))
    if in_parts:
        schedule["milestones"] = [round(at / (schedule["epochs"] or 1), 9) for at in schedule["milestones"]]
    del schedule["steps"], schedule["epochs"]
    settled = {key: run[key] for key in ("seed", "data", "textures", "validate", "start") if key in run}
    return {**settled, **recipe, **{f"schedule.{key}": value for key, value in schedule.items()}}


def _differing(before: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    return {key: (value, now[key]) for key, value in before.items() if key in now and now[key] != value}


def _best_bad_3(out: Path) -> float | None:
    """Of the best network that a run has saved; None if there is none."""
    record = out / "best" / "training.json"
    return float(_read_json(record)["validation"]["validation/bad_3"]) if record.is_file() else None


def is_first_process() -> bool:
    """Whether this is the one process of several that writes and prints."""
    return getattr(rank_zero_only, "rank", 0) == 0


def _circumstances(command: str | None) -> dict[str, Any]:
    return {"command": command, "commit": commit(), "versions": versions(), "machine": machine()}


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return cast(dict[str, Any], json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{str(path)!r} can't be read: {error}") from error


def _write_json(path: Path, values: Mapping[str, Any]) -> None:
    with atomic_path(path, overwrite=True) as temporary:
        temporary.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def _check_counts(**values: int | None) -> None:
    for name, value in values.items():
        least = 0 if name == "workers" else 1
        if value is not None and value < least:
            raise ConfigError(f"{name} is {value}; expected at least {least}")


def with_length(recipe: Recipe, *, steps: int | None = None, batch: int | None = None) -> Recipe:
    """The recipe with another number of steps, or another batch.

    >>> from stereokit.training import load_recipe
    >>> with_length(load_recipe("sceneflow"), steps=100).schedule.total_steps(35_454)
    100
    """
    schedule = recipe.schedule
    if steps is not None:
        end = schedule.epochs or 1
        milestones = tuple(milestone / end for milestone in schedule.milestones)
        schedule = replace(schedule, steps=steps, epochs=None, milestones=milestones)
    if batch is not None:
        schedule = replace(schedule, batch=batch)
    return replace(recipe, schedule=schedule)
