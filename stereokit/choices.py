"""One choice for one slot: a registered component with its arguments, or a block made elsewhere."""

from collections.abc import Mapping
from typing import Any, cast

from torch import nn

from stereokit.backbones.encoder import is_timm_model, near_timm_models
from stereokit.checks import check_interface
from stereokit.config import Component, Override, Presets
from stereokit.errors import ConfigError
from stereokit.registry import (
    AGGREGATIONS,
    BACKBONES,
    CANDIDATES,
    COSTS,
    GUIDANCE,
    REFINEMENTS,
    REGRESSIONS,
    UPSAMPLERS,
    Registry,
    suggest,
)

__all__ = ["SLOTS", "Choice", "GuidanceMaker"]

SLOTS: dict[str, Registry] = {
    "backbone": BACKBONES,
    "candidates": CANDIDATES,
    "cost": COSTS,
    "guidance": GUIDANCE,
    "aggregation": AGGREGATIONS,
    "regression": REGRESSIONS,
    "upsampler": UPSAMPLERS,
    "refinement": REFINEMENTS,
}


class Choice:
    """One choice: a registered component with its arguments, or a block made elsewhere.

    Args:
        slot: that it is for.
        choice: what was chosen.
        default: the component whose arguments a choice without a name changes.
        presets: arguments for components of this slot, by name.
    """

    def __init__(
        self, slot: str, choice: Override, default: Component | None = None, presets: Presets | None = None
    ) -> None:
        self.slot = slot
        self.registry = SLOTS[slot]
        self.block: nn.Module | None = None
        if isinstance(choice, nn.Module):
            self.block = choice
            self.resolved: Component = {"instance": f"{type(choice).__module__}.{type(choice).__qualname__}"}
            return
        given: Component = {"name": choice} if isinstance(choice, str) else choice
        if not isinstance(given, Mapping):
            raise ConfigError(
                f"{slot}={choice!r}: expected a component's name, a dict {{'name': ..., **arguments}} or a module"
            )
        if "instance" in given:
            raise ConfigError(
                f"the configuration was made with a {slot} of {given['instance']} that was passed in as a module, "
                f"which JSON can't rebuild; pass it again, {slot}=..., or register the class and pass its name"
            )
        arguments = dict(given)
        name = arguments.pop("name", (default or {}).get("name"))
        if not isinstance(name, str):
            raise ConfigError(f"the name of a {slot} is a string, not {name!r}")
        if slot == "backbone" and name not in BACKBONES:
            if not is_timm_model(name):
                near = " or ".join(map(repr, near_timm_models(name)))
                such_as = f", such as {near}" if near else ""
                raise ConfigError(
                    f"unknown backbone {name!r}; {suggest(name, BACKBONES.names())}, or the name of a timm model"
                    f"{such_as}"
                )
            arguments["encoder"] = name
            name = "unet"
        own = {k: v for k, v in default.items() if k != "name"} if default and name == default.get("name") else {}
        self.name: str = name
        self.arguments = {**(presets or {}).get(slot, {}).get(name, {}), **own, **arguments}
        self.resolved = {"name": name, **self.arguments}
        self.registry.get(name)

    def __str__(self) -> str:
        return f"{self.slot} {self.resolved.get('name', self.resolved.get('instance'))!r}"

    def build(self, **offered: Any) -> Any:
        """The block; `offered` is what its neighbours decide."""
        if self.block is not None:
            if offered.get("pretrained"):
                raise ConfigError(f"{self} was passed in as a module, with its weights: leave out pretrained_backbone")
            check_interface(self.slot, self.block)
            return self.block
        decided = [key for key in self.arguments if key in offered and key != "pretrained"]
        if decided:
            raise ConfigError(f"{', '.join(decided)} of {self} follows from the rest of the network; leave it out")
        if offered.get("pretrained") and "pretrained" not in self.registry.parameters(self.name):
            raise ConfigError(f"{self} has no pretrained weights to load")
        self.resolved = {"name": self.name, **self.registry.resolve(self.name, self.arguments, offered)}
        # the weights that a block starts from are no part of what it is: a saved network brings its own
        self.resolved.pop("pretrained", None)
        block = self.registry.build(self.name, self.arguments, offered)
        check_interface(self.slot, block)
        return block

    def plainly(self, name: str, *, but_for: str) -> bool:
        """Whether it is the component of this name, without arguments but for one."""
        others = (value for key, value in self.arguments.items() if key != but_for)
        return self.block is None and self.name == name and not any(others)

    def takes(self, name: str) -> bool:
        """Whether the component can be told this; a block made elsewhere has been told all."""
        return self.block is None and name in self.registry.parameters(self.name)

    def chosen(self, name: str) -> Any:
        """The argument of this name that was given, or what a block made elsewhere has; None without one."""
        return self.arguments.get(name) if self.block is None else getattr(self.block, name, None)

    def attribute(self, name: str, default: Any) -> Any:
        """What the block, or the class that is going to be built, says of itself."""
        return getattr(self.registry.get(self.name) if self.block is None else self.block, name, default)


class GuidanceMaker:
    """Makes the guidance blocks of one aggregation; keeps to the one module where it was given as such.

    Args:
        choice: for the guidance slot.
    """

    def __init__(self, choice: Choice) -> None:
        self.choice = choice
        self.made = 0
        if choice.block is None:
            channels = {"guide_channels": None, "volume_channels": None}
            arguments = choice.registry.resolve(choice.name, choice.arguments, channels)
            choice.resolved = {"name": choice.name, **arguments}

    @property
    def guides(self) -> bool:
        """Whether there is anything to make."""
        return self.choice.block is not None or self.choice.name != "none"

    def __call__(self, *, guide_channels: int, volume_channels: int) -> nn.Module:
        """A block for one place."""
        self.made += 1
        channels = {"guide_channels": guide_channels, "volume_channels": volume_channels}
        if self.choice.block is None:
            return cast(nn.Module, self.choice.registry.build(self.choice.name, self.choice.arguments, channels))
        block = self.choice.block
        kind = type(block).__name__
        if self.made > 1:
            raise ConfigError(
                f"guidance {kind} was passed in as one module, but the aggregation has several places for it; use "
                "guidance_at='one', or register the class and pass its name"
            )
        for what, wanted in channels.items():
            has = getattr(block, what, wanted)
            if has != wanted:
                raise ConfigError(f"guidance {kind} has {what} {has}, but the aggregation's place for it has {wanted}")
        return block
