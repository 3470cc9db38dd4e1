"""The network that validated best."""

from collections.abc import Callable
from typing import Any

from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

__all__ = ["BestNetwork"]


class BestNetwork(Callback):
    """Saves a network whenever its mean bad-3 in validation is the smallest so far.

    Args:
        save: what is called then, in the first process.
    """

    def __init__(self, save: Callable[[], object]) -> None:
        self.save = save
        self.smallest: float | None = None

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Behind the count of the errors."""
        errors: Any = pl_module.errors
        bad = errors["validation/bad_3"]
        if self.smallest is None or bad < self.smallest:
            self.smallest = bad
            if trainer.is_global_zero:
                self.save()

    def state_dict(self) -> dict[str, Any]:
        """The smallest so far, for runs that go on."""
        return {"smallest": self.smallest}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """The reverse of `state_dict`."""
        self.smallest = state_dict["smallest"]
