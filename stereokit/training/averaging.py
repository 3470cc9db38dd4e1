"""The average of the weights, by Lightning's callback."""

from collections.abc import Callable
from typing import Any, cast

import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor

from stereokit.network import StereoNetwork
from stereokit.training.recipe import Averaging

__all__ = ["AveragedWeights"]


class AveragedWeights(WeightAveraging):
    """Averages weights and batch statistics after each step: validation and what is saved use the average.

    The new weights' share in it is

    - "ema": 1 - min(decay, (1 + n) / (10 + n)) after n steps, so that the random weights of the start are soon gone;
    - "swa": 1 up to `start`, then 1 / n for the n-th step from there on.

    Args:
        settings: kind and numbers.
        progress: of the run, from 0 to 1.

    Source: Izmailov et al., "Averaging weights leads to wider optima and better generalization", UAI 2018.
    """

    def __init__(self, settings: Averaging, progress: Callable[[], float]) -> None:
        super().__init__(multi_avg_fn=self._update)
        self.settings = settings
        self.progress = progress
        self.averaged_steps = 0

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Keeps the average where the network will be: it is still on the CPU here."""
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)

    def share(self) -> float:
        """Of the next weights."""
        if self.settings.kind == "swa":
            return 1 / max(self.averaged_steps, 1)
        return 1 - min(self.settings.decay, (1 + self.averaged_steps) / (10 + self.averaged_steps))

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Counts the step before it is averaged."""
        counts = self.settings.kind == "ema" or self.progress() >= self.settings.start
        # a run that is made longer may be ahead of the start again
        self.averaged_steps = self.averaged_steps + 1 if counts else 0
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    @property
    def network(self) -> StereoNetwork:
        """The network with the average."""
        assert self._average_model is not None
        training = cast(Any, self._average_model.module)
        return cast(StereoNetwork, training.model)

    def state_dict(self) -> dict[str, Any]:
        """Adds the number of steps in the average."""
        return {**super().state_dict(), "averaged_steps": self.averaged_steps}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """The reverse of `state_dict`."""
        super().load_state_dict(state_dict)
        self.averaged_steps = state_dict["averaged_steps"]

    @torch.no_grad()
    def _update(self, average: list[Tensor], current: list[Tensor], _count: Any) -> None:
        share = self.share()
        for mean, new in zip(average, current, strict=True):
            if mean.is_floating_point():
                mean.lerp_(new.to(mean.dtype), share)
            else:
                mean.copy_(new)
