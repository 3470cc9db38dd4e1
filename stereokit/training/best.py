"""The network that validated best."""

import warnings
from collections.abc import Callable
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

__all__ = ["BestNetwork"]


class BestNetwork(Callback):
    """Saves a network whenever its mean bad-3 in validation is the smallest so far.

    Args:
        save: what is called then, in the first process.
        smallest: of a run that goes on.
    """

    def __init__(self, save: Callable[[], object], smallest: float | None = None) -> None:
        self.save = save
        self.smallest = smallest

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """After the errors are counted."""
        errors: Any = pl_module.errors
        bad = errors.get("validation/bad_3")
        if bad is None:
            said = "no pixel of the validation pairs has ground truth that counts: none of the networks is the best"
            warnings.warn(said, stacklevel=2)
            return
        if self.smallest is None or bad < self.smallest:
            self.smallest = bad
            if trainer.is_global_zero:
                self.save()
