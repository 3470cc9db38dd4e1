"""The checkpoint of a run."""

from pathlib import Path
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint

__all__ = ["LastCheckpoint"]


class LastCheckpoint(Checkpoint):
    """Writes the state of the run to one file every so many steps, and after the last one to a file of its own.

    `finish` puts that one in the other's place, when the network is saved: a run that is killed before still has its
    end to come. A step that is validated is written after its validation, which a run that is killed in it repeats.

    Args:
        path: of the file.
        every: steps between checkpoints.
        validate_every: steps between validations; None where there are none.
    """

    def __init__(self, path: Path, every: int, validate_every: int | None) -> None:
        self.path = path
        self.end, self.part = (path.with_name(name) for name in ("end.ckpt", "part.ckpt"))
        self.every = every
        self.validate_every = validate_every

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Writes what is not validated first."""
        if trainer.should_stop:
            trainer.save_checkpoint(self.end)
        elif self.validate_every is None or trainer.global_step % self.validate_every:
            self._write(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Writes what is."""
        if not trainer.should_stop:
            self._write(trainer)

    def finish(self) -> None:
        """Makes the end of the run its last checkpoint."""
        self.end.replace(self.path)
        self.part.unlink(missing_ok=True)

    def _write(self, trainer: Trainer) -> None:
        if trainer.global_step % self.every:
            return
        # Lightning's own temporary file lies elsewhere, and a move from there is no single step
        trainer.save_checkpoint(self.part)
        if trainer.is_global_zero:
            self.part.replace(self.path)
