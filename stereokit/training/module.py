"""The network, its loss and its optimiser, as Lightning runs them."""

import time
from collections.abc import Iterator
from typing import Any, cast

import torch
from lightning.pytorch import LightningModule
from torch import Tensor, nn

from stereokit.contracts import StereoOutput
from stereokit.errors import ConfigError, StereoKitError
from stereokit.losses import masked_cross_entropy, named_loss, stereo_loss, truth_of_cells
from stereokit.metrics import StereoMetrics, valid_pixels
from stereokit.network import StereoNetwork
from stereokit.optimize import prepare_for_training
from stereokit.runtime.memory import running_out_as
from stereokit.training.recipe import Recipe
from stereokit.training.samples import Batch

__all__ = ["StereoTraining", "TrainingError"]

MOST_BROKEN_STEPS = 20


class TrainingError(StereoKitError):
    """Training that can't go on."""


class StereoTraining(LightningModule):
    """One training step, one validation step, and what they need.

    The learning rate follows the recipe's schedule over the steps of the run or, with `minutes`, over the wall-clock
    time spent in training. A step whose loss or gradient is not finite changes neither weights nor batch statistics.

    Args:
        model: to train; it shares its parameters and buffers with the network in `self.model`, see
            `stereokit.optimize.prepare_for_training`.
        recipe: what to do.
        steps: of the whole run.
        minutes: wall-clock time of the whole run, over all its resumptions, its last validation included as far as
            it can be foreseen; None for as long as the steps take.
        validation: name of each validation set, in the order of the validation loaders.
        compile: train through `torch.compile`.

    Raises:
        ConfigError: a loss that is not known, or a network that can't be copied.

    Attributes:
        pairs_seen: training pairs so far, over all processes.
        errors: of the last validation, as they are logged.
    """

    def __init__(
        self,
        model: StereoNetwork,
        recipe: Recipe,
        *,
        steps: int,
        minutes: float | None = None,
        validation: tuple[str, ...] = (),
        compile: bool = False,
    ) -> None:
        super().__init__()
        self.measure = named_loss(recipe.loss.kind)
        # a twin, so that the network that was given keeps its classes
        self.model = prepare_for_training(model)
        self.recipe = recipe
        self.steps = steps
        self.minutes = minutes
        self.validation = validation
        self.compile_network = compile
        # in a list, so that it is no second submodule
        self._network: list[nn.Module] = [self.model]
        self.pairs_seen = 0
        self.errors: dict[str, float] = {}
        self.broken_steps = 0
        self._broken_in_a_row = 0
        self._seconds_before = 0.0
        self._started: float | None = None
        self._timed_steps = 0
        self._timed_seconds = 0.0
        self._step_ended: float | None = None
        self._validation_seconds: float | None = None
        self._validation_started = 0.0
        self._metrics: list[StereoMetrics] = []
        self._statistics_before: list[Tensor] = []

    @property
    def seconds(self) -> float:
        """Wall-clock time spent in training, validation included, over all resumptions."""
        return self._seconds_before + (0.0 if self._started is None else time.monotonic() - self._started)

    @property
    def progress(self) -> float:
        """From 0 at the start to 1 at the end."""
        done = self.trainer.global_step / self.steps
        if self.minutes is not None:
            # all processes go by the clock of the first
            time_done = self.seconds / (60 * self.minutes - self._seconds_at_the_end(self.minutes))
            done = max(done, self.trainer.strategy.broadcast(time_done))
        return min(done, 1.0)

    def _seconds_at_the_end(self, minutes: float) -> float:
        """For one more step and the last validation, but never more than half of the time."""
        if not self._timed_steps:
            return 0.0
        step = self._timed_seconds / self._timed_steps
        validation = self._validation_seconds
        if validation is None:
            # a pair is larger than in training, but has no gradient: it takes about as long
            pairs = sum(self.trainer.num_val_batches) * self.trainer.world_size
            validation = step * pairs / self.recipe.schedule.batch
        return min(step + validation, 30 * minutes)

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        """The network."""
        output: StereoOutput = self._network[0](left, right)
        return output

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """The recipe's; `on_train_batch_start` sets its learning rate."""
        return self.recipe.optimisation.optimiser(self.model.named_parameters())

    def on_train_start(self) -> None:
        """Starts the clock."""
        self._started = time.monotonic()
        if self.compile_network:
            self._network = [torch.compile(self.model)]  # type: ignore[list-item]

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Sets the learning rate, and says which step is the last: Lightning validates after it."""
        progress = self.progress
        rate = self.recipe.optimisation.learning_rate * self.recipe.schedule.learning_rate_factor(progress)
        for group in self.optimizers().param_groups:  # type: ignore[union-attr]
            group["lr"] = rate * group["factor"]
        if progress >= 1 or self.trainer.global_step + 1 >= self.steps:
            self.trainer.should_stop = True
        self.log("learning_rate", rate)

    def on_train_batch_end(self, outputs: Any, batch: Batch, batch_idx: int) -> None:
        """Takes the time from the end of one step to that of the next; the first, which may compile, is left out."""
        now = self.seconds
        if self._step_ended is not None:
            self._timed_steps += 1
            self._timed_seconds += now - self._step_ended
        self._step_ended = now

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of a batch.

        With several processes, each mean over known pixels is weighted by how many of them the process has, so that
        the mean of the gradients is that of one process with the joint batch.
        """
        self._statistics_before = [buffer.clone() for buffer in self._batch_statistics()]
        output = self(batch["left"], batch["right"])
        truth, settings = batch["disparity"], self.recipe.loss
        weights = self.model.auxiliary_weights
        distance = stereo_loss(
            output, truth, auxiliary_weights=weights, loss=self.measure, max_disparity=settings.max_disparity
        )
        loss = self._shared(distance, truth)
        if settings.cross_entropy:
            entropy, cells = self._cross_entropy(output, truth)
            entropy = self._shared(entropy, cells)
            self.log("cross_entropy", entropy)
            loss = loss + settings.cross_entropy * entropy
        self.pairs_seen += len(truth) * self.trainer.world_size
        self.log("loss", loss, prog_bar=True)
        self.log("pairs_seen", float(self.pairs_seen))
        return loss

    def _cross_entropy(self, output: StereoOutput, truth: Tensor) -> tuple[Tensor, Tensor]:
        """Of the best head, and the ground truth that it goes by.

        Raises:
            ConfigError: the network predicts without a distribution.
        """
        distribution = output.distribution
        if distribution is None:
            raise ConfigError(
                f"cross_entropy is for networks with a distribution over disparity; {type(self.model).__name__} "
                "has none: set it to 0 in [loss]"
            )
        entropy = masked_cross_entropy(distribution, truth, max_disparity=self.recipe.loss.max_disparity)
        return entropy, truth_of_cells(truth, distribution.stride)

    def _shared(self, mean: Tensor, truth: Tensor) -> Tensor:
        """A mean over known pixels, weighted so that its mean over the processes is that over all their pixels."""
        if self.trainer.world_size == 1:
            return mean
        count = valid_pixels(truth, max_disparity=self.recipe.loss.max_disparity).sum().float()
        everywhere = cast(Tensor, self.all_gather(count))
        return mean * count / everywhere.mean().clamp(min=1)

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Leaves out a step whose gradient is not finite.

        Raises:
            TrainingError: too many in a row.
        """
        gradients = [p.grad for p in self.parameters() if p.grad is not None]
        if torch.stack(torch._foreach_norm(gradients)).isfinite().all():
            self._broken_in_a_row = 0
            return
        self.broken_steps += 1
        self._broken_in_a_row += 1
        for parameter in self.parameters():
            parameter.grad = None
        for buffer, value in zip(self._batch_statistics(), self._statistics_before, strict=True):
            buffer.copy_(value)
        self.log("broken_steps", float(self.broken_steps))
        if self._broken_in_a_row >= MOST_BROKEN_STEPS:
            raise TrainingError(
                f"{self._broken_in_a_row} steps in a row, up to step {self.trainer.global_step}, had no finite loss or "
                "gradient; use a smaller learning rate, --precision 32, or another look at the data "
                "(stereokit data check)"
            )

    def on_validation_epoch_start(self) -> None:
        """Begins to count."""
        self._validation_started = self.seconds
        self._metrics = [StereoMetrics(max_disparity=self.recipe.loss.max_disparity) for _ in self.validation]

    def validation_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> Tensor:
        """Counts the errors of a pair, and gives its disparity for the pictures."""
        height, width = batch["left"].shape[-2:]
        with running_out_as(f"a validation pair of {width} x {height} pixels takes more memory than there is"):
            disparity: Tensor = self.model(batch["left"], batch["right"]).disparity
        self._metrics[dataloader_idx].update(disparity, batch["disparity"])
        return disparity

    def on_validation_epoch_end(self) -> None:
        """Logs the errors of each set, and their mean over the sets."""
        self.errors = {}
        means: dict[str, list[float]] = {"bad_3": [], "epe": []}
        for name, counted in zip(self.validation, self._metrics, strict=True):
            if self.trainer.world_size > 1:
                counted = counted.merged_over_processes()
            result = counted.compute()
            for metric, values in means.items():
                value = result[metric]
                if value is not None:
                    values.append(float(value))
                    self.errors[f"{name}/{metric}"] = float(value)
        self.log_dict(self.errors)
        for metric, values in means.items():
            if values:
                self.errors[f"validation/{metric}"] = sum(values) / len(values)
                self.log(f"validation/{metric}", self.errors[f"validation/{metric}"], prog_bar=True)
        self._validation_seconds = self.seconds - self._validation_started
        self._step_ended = None

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """What the run needs besides Lightning's own state."""
        ended_by_minutes = self.trainer.should_stop and self.trainer.global_step < self.steps
        checkpoint["stereokit"] = {
            "seconds": self.seconds,
            "pairs_seen": self.pairs_seen,
            "broken_steps": self.broken_steps,
            "ended_by_minutes": self.minutes if ended_by_minutes else None,
        }

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """The reverse of `on_save_checkpoint`."""
        state = checkpoint["stereokit"]
        self._seconds_before = state["seconds"]
        self.pairs_seen = state["pairs_seen"]
        self.broken_steps = state["broken_steps"]

    def _batch_statistics(self) -> Iterator[Tensor]:
        for module in self.model.modules():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                yield from module.buffers(recurse=False)
