"""Lightning's trainer: set up from a recipe and a machine, and run without noise."""

import logging
import signal
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch import LightningDataModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only

from stereokit.errors import ConfigError, StereoKitError
from stereokit.runtime.memory import running_out_as
from stereokit.runtime.processor import cpu_has
from stereokit.training.machine import Machine
from stereokit.training.module import StereoTraining

__all__ = ["build_trainer", "fit", "is_first_process"]

TOO_MUCH_MEMORY = "a step takes more memory than there is; use a smaller --batch, or a smaller crop in [augmentation]"


def build_trainer(
    machine: Machine, out: Path, training: StereoTraining, callbacks: list[Callback], *, validate_every: int
) -> Trainer:
    """The trainer of a run.

    Raises:
        ConfigError: the machine does not have what is asked for.

    Warns:
        UserWarning: a precision that makes training slower here.
    """
    optimisation = training.recipe.optimisation
    try:
        with _without_noise():
            trainer = Trainer(
                accelerator=machine.accelerator,
                devices=machine.devices,
                num_nodes=machine.nodes,
                precision=machine.precision,  # type: ignore[arg-type]
                max_steps=training.steps,
                max_epochs=1,
                gradient_clip_val=optimisation.gradient_clip,
                gradient_clip_algorithm=optimisation.gradient_clip_by,
                val_check_interval=validate_every,
                limit_val_batches=None if training.validation else 0,
                check_val_every_n_epoch=None,
                num_sanity_val_steps=0,
                use_distributed_sampler=False,
                log_every_n_steps=min(20, training.steps),
                callbacks=callbacks,
                logger=[CSVLogger(out / "logs", "csv"), TensorBoardLogger(out / "logs", "tensorboard")],
                default_root_dir=out,
                enable_model_summary=False,
            )
    except (MisconfigurationException, ValueError, ImportError) as error:
        raise ConfigError(
            f"this machine does not train on accelerator {machine.accelerator!r}, devices {machine.devices!r} with "
            f"precision {machine.precision!r}: {' '.join(str(error).split())}"
        ) from error
    on_cpu = trainer.strategy.root_device.type == "cpu"
    if on_cpu and machine.precision.startswith("bf16") and not cpu_has(torch.bfloat16):
        warnings.warn(
            f"this processor has no instructions for bfloat16, so that precision {machine.precision!r} is slower here "
            "than the default of 32",
            stacklevel=3,
        )
    return trainer


def fit(trainer: Trainer, training: StereoTraining, loaders: LightningDataModule, checkpoint: Path | None) -> None:
    """Trains to the end, from a checkpoint if there is one.

    Raises:
        InputError: a pair can't be read, or there is too little memory; in one line.
        KeyboardInterrupt: Ctrl-C.
    """
    interruption = signal.getsignal(signal.SIGINT)
    path = None if checkpoint is None else str(checkpoint)
    try:
        with _without_noise(), _in_one_line(), running_out_as(f"{training.recipe.name}: {TOO_MUCH_MEMORY}"):
            trainer.fit(training, loaders, ckpt_path=path, weights_only=True)
    except SystemExit as error:
        # what Lightning makes of Ctrl-C
        if isinstance(error.__context__, KeyboardInterrupt):
            # which it has switched off, for good
            signal.signal(signal.SIGINT, interruption)
            raise error.__context__ from None
        raise


def is_first_process() -> bool:
    """Whether this is the one process of several that writes and prints."""
    return getattr(rank_zero_only, "rank", 0) == 0


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
