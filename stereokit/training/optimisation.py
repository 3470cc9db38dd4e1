"""The optimiser of a recipe."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import nn

from stereokit.errors import ConfigError
from stereokit.training.fields import check_fields, check_unused, is_number

__all__ = ["Optimisation"]

_USED = {"adam": ("betas",), "adamw": ("betas",), "rmsprop": ("smoothing",)}


@dataclass(frozen=True, kw_only=True)
class Optimisation:
    """How the weights follow their gradient.

    Attributes:
        kind: "adam"; "adamw", in which the decay of the weights is apart from the gradient; or "rmsprop".
        learning_rate: before the schedule.
        factors: of the learning rate of some weights: those that have the key as a part of their name, between dots.
        betas: of "adam" and "adamw", decay of the averages of the gradient and of its square.
        smoothing: of "rmsprop", decay of the average of the gradient's square.
        weight_decay: of all parameters; it is added to the gradient times the weight, or with "adamw" taken off the
            weight times the learning rate.
        gradient_clip: largest gradient; None for any.
        gradient_clip_by: what `gradient_clip` is the largest of: the "norm" of the gradient of all parameters together,
            or the absolute "value" of each number of it.

    Raises:
        ConfigError: a value of another type or out of range, or one that has no effect.

    Source: Kingma and Ba, "Adam: a method for stochastic optimization", ICLR 2015; Loshchilov and Hutter, "Decoupled
    weight decay regularization", ICLR 2019; Tieleman and Hinton, lecture 6.5 of "Neural networks for machine learning",
    2012.

    >>> optimisation = Optimisation(kind="adamw", weight_decay=1e-5)
    >>> type(optimisation.optimiser(nn.Linear(2, 2).named_parameters())).__name__
    'AdamW'
    """

    kind: Literal["adam", "adamw", "rmsprop"] = "adam"
    learning_rate: float = 1e-3
    factors: Mapping[str, float] = field(default_factory=dict)
    betas: tuple[float, float] = (0.9, 0.999)
    smoothing: float = 0.99
    weight_decay: float = 0.0
    gradient_clip: float | None = None
    gradient_clip_by: Literal["norm", "value"] = "norm"

    def __post_init__(self) -> None:
        check_fields("optimisation", self)
        for key in ("learning_rate", "gradient_clip"):
            value = getattr(self, key)
            if value is not None and value <= 0:
                raise ConfigError(f"optimisation: {key} must be positive, got {value}")
        if not all(0 <= beta < 1 for beta in self.betas):
            raise ConfigError(f"optimisation: betas are two numbers from 0 to below 1; got {list(self.betas)}")
        if not 0 <= self.smoothing < 1:
            raise ConfigError(f"optimisation: smoothing lies from 0 to below 1; got {self.smoothing}")
        if self.weight_decay < 0:
            raise ConfigError(f"optimisation: weight_decay is 0 or larger; got {self.weight_decay}")
        if self.gradient_clip is None and self.gradient_clip_by != "norm":
            raise ConfigError("optimisation: gradient_clip_by has no effect without gradient_clip; give both or none")
        for key, factor in self.factors.items():
            if not is_number(factor) or factor <= 0:
                raise ConfigError(f"optimisation: the factor of {key!r} has to be a positive number, got {factor!r}")
        check_unused("optimisation", self, self.kind, _USED)

    def optimiser(self, parameters: Iterable[tuple[str, nn.Parameter]]) -> torch.optim.Optimizer:
        """The optimiser of the kind, at the learning rate before the schedule; each group has its `factor` of it.

        Args:
            parameters: of a network, with their names.

        Raises:
            ConfigError: one of the factors is of no weight.
        """
        groups = self._groups(parameters)
        if self.kind == "rmsprop":
            return torch.optim.RMSprop(
                groups, lr=self.learning_rate, alpha=self.smoothing, weight_decay=self.weight_decay
            )
        cls = torch.optim.AdamW if self.kind == "adamw" else torch.optim.Adam
        return cls(groups, lr=self.learning_rate, betas=self.betas, weight_decay=self.weight_decay)

    def _groups(self, parameters: Iterable[tuple[str, nn.Parameter]]) -> list[dict[str, Any]]:
        """The weights by their factor."""
        members: dict[str | None, list[nn.Parameter]] = {None: [], **{key: [] for key in self.factors}}
        for name, parameter in parameters:
            members[next((key for key in self.factors if key in name.split(".")), None)].append(parameter)
        for key in self.factors:
            if not members[key]:
                raise ConfigError(f"optimisation: no weight has {key!r} in its name, so that its factor has no effect")
        factors = [1.0, *self.factors.values()]
        return [
            {"params": group, "factor": factor, "lr": self.learning_rate * factor}
            for factor, group in zip(factors, members.values(), strict=True)
            if group
        ]
