"""How long a training run lasts, and its learning rate meanwhile."""

import math
from dataclasses import dataclass, replace
from typing import Literal

from stereokit.errors import ConfigError
from stereokit.training.fields import check_fields, check_unused

__all__ = ["Schedule"]

_USED = {
    "milestones": ("milestones", "factor"),
    "one_cycle": ("initial", "final", "shape"),
    "exponential": ("factor", "every"),
}


@dataclass(frozen=True, kw_only=True)
class Schedule:
    r"""How long training lasts, and what the learning rate does meanwhile.

    The learning rate is a function of progress p, from 0 at the start to 1 at the end, so that the same schedule fits a
    number of steps, a number of epochs or a number of minutes. It is the recipe's learning rate times a factor f(p):

    - "milestones": `factor` to the power of the number of milestones passed;
    - "exponential": `factor` to the power of p / `every`, which falls evenly;
    - "one_cycle": from `initial` at the start over 1 at p = `warmup` to `final` at the end, by half a cosine each, or
      in straight lines. Without `warmup` it falls all the way.

    In the first two kinds f rises in a straight line from 0 over the first `warmup` besides.

    Attributes:
        batch: pairs a step, over all processes.
        steps: of the optimiser; or
        epochs: passes over the data.
        kind: "milestones", "one_cycle" or "exponential".
        warmup: part of the run in which the learning rate rises.
        milestones: progress at which the learning rate is multiplied by `factor`; where `epochs` is given, in epochs.
        factor: see `milestones` and `every`.
        every: part of the run in which an "exponential" schedule falls by `factor`; where `epochs` is given, in epochs.
        initial: of "one_cycle", the factor at the start of a warm-up.
        final: of "one_cycle", the factor at the end.
        shape: of "one_cycle", "cosine" or "linear".

    Raises:
        ConfigError: both or neither of steps and epochs, values of another type or out of range, or one that has no
            effect with the kind.

    Source: "one_cycle" is Smith and Topin, "Super-convergence: very fast training of neural networks using large
    learning rates", 2018, in the form of `torch.optim.lr_scheduler.OneCycleLR`, whose pct_start is `warmup`,
    div_factor 1 / `initial` and final_div_factor `initial` / `final`.

    >>> schedule = Schedule(batch=8, epochs=10, milestones=(7,), factor=0.1)
    >>> [round(schedule.learning_rate_factor(progress), 3) for progress in (0.0, 0.69, 0.7, 0.99)]
    [1.0, 1.0, 0.1, 0.1]
    >>> schedule = Schedule(batch=8, steps=1000, kind="one_cycle", warmup=0.2)
    >>> [round(schedule.learning_rate_factor(progress), 3) for progress in (0.0, 0.1, 0.2, 0.6, 1.0)]
    [0.04, 0.52, 1.0, 0.5, 0.0]
    """

    batch: int
    steps: int | None = None
    epochs: int | None = None
    kind: Literal["milestones", "one_cycle", "exponential"] = "milestones"
    warmup: float = 0.0
    milestones: tuple[float, ...] = ()
    factor: float = 0.1
    every: float = 1.0
    initial: float = 1 / 25
    final: float = 1 / 250_000
    shape: Literal["cosine", "linear"] = "cosine"

    def __post_init__(self) -> None:
        check_fields("schedule", self)
        if (self.steps is None) == (self.epochs is None):
            raise ConfigError(f"schedule: expected steps or epochs, got steps={self.steps} and epochs={self.epochs}")
        for key in ("batch", "steps", "epochs", "factor", "every"):
            value = getattr(self, key)
            if value is not None and value <= 0:
                raise ConfigError(f"schedule: {key} must be positive, got {value}")
        if not 0 <= self.warmup < 1:
            raise ConfigError(f"schedule: warmup is a part of the run, from 0 to below 1; got {self.warmup}")
        for key in ("initial", "final"):
            if not 0 <= getattr(self, key) <= 1:
                raise ConfigError(
                    f"schedule: {key} is a part of the learning rate from 0 to 1; got {getattr(self, key)}"
                )
        if any(not 0 < milestone < self._end for milestone in self.milestones):
            unit = "epochs" if self.epochs else "parts of the run"
            raise ConfigError(f"schedule: milestones are {unit} between 0 and {self._end}; got {list(self.milestones)}")
        check_unused("schedule", self, self.kind, _USED)
        if self.kind == "one_cycle" and not self.warmup and self.initial != 1 / 25:
            raise ConfigError(f"schedule: initial = {self.initial} has no effect without a warmup; leave it out")

    def learning_rate_factor(self, progress: float) -> float:
        """What the learning rate is multiplied by at this progress in [0, 1]."""
        rising = progress < self.warmup
        if self.kind == "one_cycle":
            if rising:
                return self._between(self.initial, 1.0, progress / self.warmup)
            return self._between(1.0, self.final, (progress - self.warmup) / (1 - self.warmup))
        if self.kind == "exponential":
            passed = progress * self._end / self.every
        else:
            passed = sum(progress >= milestone / self._end for milestone in self.milestones)
        factor: float = self.factor**passed
        return progress / self.warmup * factor if rising else factor

    def total_steps(self, pairs: int) -> int:
        """Steps of the whole run over a data set of so many pairs."""
        return self.steps or math.ceil((self.epochs or 0) * pairs / self.batch)

    def of_steps(self, steps: int) -> "Schedule":
        """The same course of the learning rate over a number of steps.

        >>> Schedule(batch=8, epochs=10, milestones=(7,)).of_steps(500).milestones
        (0.7,)
        """
        milestones = tuple(milestone / self._end for milestone in self.milestones)
        every = self.every / self._end if self.kind == "exponential" else self.every
        return replace(self, steps=steps, epochs=None, milestones=milestones, every=every)

    @property
    def _end(self) -> int:
        """Where the run ends, in the unit of milestones."""
        return self.epochs or 1

    def _between(self, start: float, end: float, part: float) -> float:
        share = (1 + math.cos(math.pi * part)) / 2 if self.shape == "cosine" else 1 - part
        return share * start + (1 - share) * end
