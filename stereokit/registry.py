"""Components by name: one `Registry` per slot of a network.

A component is registered with a decorator, by this package or any other::

    @COSTS.register("mine")
    class MyCost(nn.Module): ...

Other packages are found through the entry-point group ``stereokit.plugins``, loaded when a registry is first read.
"""

import difflib
import fnmatch
import inspect
import warnings
from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from typing import Any, TypeVar

from stereokit.errors import ConfigError, StereoKitError

__all__ = [
    "AGGREGATIONS",
    "BACKBONES",
    "CANDIDATES",
    "COSTS",
    "GUIDANCE",
    "LOSSES",
    "MODELS",
    "REFINEMENTS",
    "REGRESSIONS",
    "UPSAMPLERS",
    "WEIGHTS",
    "Registry",
    "list_components",
    "list_models",
    "suggest",
]

PLUGIN_GROUP = "stereokit.plugins"

Factory = TypeVar("Factory", bound=Callable[..., Any])


def suggest(name: str, known: list[str]) -> str:
    """The end of an error message about an unknown name: near names, then all of them.

    >>> suggest("CoExx", ["coex", "psmnet"])
    "did you mean 'coex'? Known: coex, psmnet"
    """
    in_lower_case = {candidate.lower(): candidate for candidate in known}
    near = [in_lower_case[n] for n in difflib.get_close_matches(name.lower(), in_lower_case, n=3, cutoff=0.5)]
    hint = f"did you mean {' or '.join(repr(n) for n in near)}? " if near else ""
    return f"{hint}Known: {', '.join(known) or 'none'}"


class Registry:
    """The components that can fill one slot, by name.

    Args:
        slot: what the registry holds, in the plural (``"costs"``).
        kind: one of them, for messages (``"cost"``).

    >>> shapes = Registry("shapes", kind="shape")
    >>> @shapes.register("disc")
    ... class Disc:
    ...     def __init__(self, radius=1.0):
    ...         self.radius = radius
    >>> shapes.names("d*")
    ['disc']
    >>> shapes.build("disc", {"radius": 2.0}).radius
    2.0
    """

    def __init__(self, slot: str, *, kind: str) -> None:
        self.slot = slot
        self.kind = kind
        self._factories: dict[str, Callable[..., Any]] = {}

    def register(self, name: str, *, override: bool = False) -> Callable[[Factory], Factory]:
        """Decorator that puts a class or function into the registry under `name`.

        Raises:
            ConfigError: the name is taken, and `override` was not given.
        """

        def decorate(factory: Factory) -> Factory:
            if name in self._factories and not override:
                holder = self._factories[name]
                raise ConfigError(
                    f"{self.kind} {name!r} is already registered, by {holder.__module__}.{holder.__qualname__}; "
                    f"choose another name, or say register({name!r}, override=True) to replace it"
                )
            self._factories[name] = factory
            return factory

        return decorate

    def remove(self, name: str) -> None:
        """Forgets what is registered under `name`.

        Raises:
            ConfigError: no such name.
        """
        self.get(name)
        del self._factories[name]

    def get(self, name: str) -> Callable[..., Any]:
        """The class or function registered under `name`.

        Raises:
            ConfigError: no such name; the message holds the nearest ones.
        """
        if name not in self:
            raise ConfigError(f"unknown {self.kind} {name!r}; {suggest(name, self.names())}")
        return self._factories[name]

    def named(self, choice: object, what: str) -> tuple[str, dict[str, Any]]:
        """The name and the arguments of a choice: a name, or ``{"name": ..., **arguments}``.

        Args:
            choice: what was given.
            what: the beginning of the message about anything else.

        Raises:
            ConfigError: it is neither.

        >>> COSTS.named({"name": "correlation", "projection": [48]}, "a part is the name of a cost")
        ('correlation', {'projection': [48]})
        """
        arguments = dict(choice) if isinstance(choice, Mapping) else {"name": choice}
        name = arguments.pop("name", None)
        if not isinstance(name, str):
            raise ConfigError(f"{what}, or {{'name': ..., **arguments}}; got {choice!r}")
        return name, arguments

    def parameters(self, name: str) -> Mapping[str, inspect.Parameter]:
        """The arguments that the component takes."""
        return inspect.signature(self.get(name)).parameters

    def names(self, pattern: str = "*") -> list[str]:
        """The registered names that match a shell-style wildcard, sorted."""
        _load_plugins()
        return sorted(fnmatch.filter(self._factories, pattern))

    def __contains__(self, name: object) -> bool:
        # a plugin may replace a component of ours, so it is loaded even where the name is known
        _load_plugins()
        return name in self._factories

    def build(self, name: str, arguments: Mapping[str, Any], offered: Mapping[str, Any] | None = None) -> Any:
        """Calls the component registered under `name`.

        Args:
            name: of the component.
            arguments: what the user chose. Each must be an argument that the component takes.
            offered: what the neighbouring blocks decide, such as channels. The component gets those it names.

        Raises:
            ConfigError: unknown name, unknown argument or missing argument, or one that the component can't work with.
        """
        parameters = self.parameters(name)
        self._check(name, arguments, parameters)
        accepted = {k: v for k, v in (offered or {}).items() if k in parameters}
        merged = {**accepted, **arguments}
        missing = [
            k
            for k, p in parameters.items()
            if k not in merged and p.default is p.empty and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
        ]
        if missing:
            raise ConfigError(f"{self.kind} {name!r} needs the argument {', '.join(missing)}, which was not given")
        try:
            return self.get(name)(**merged)
        except StereoKitError:
            raise
        except (TypeError, ValueError) as error:
            given = ", ".join(f"{k}={v!r}" for k, v in arguments.items()) or "its defaults"
            raise ConfigError(f"{self.kind} {name!r} can't be built with {given}: {error}") from error

    def resolve(self, name: str, arguments: Mapping[str, Any], offered: Mapping[str, Any]) -> dict[str, Any]:
        """All arguments with which `build` would call the component, less the offered ones: its full configuration."""
        parameters = self.parameters(name)
        self._check(name, arguments, parameters)
        defaults = {k: p.default for k, p in parameters.items() if p.default is not p.empty and k not in offered}
        return {**defaults, **arguments}

    def _check(self, name: str, arguments: Mapping[str, Any], parameters: Mapping[str, inspect.Parameter]) -> None:
        if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            return
        for key in arguments:
            if key not in parameters:
                raise ConfigError(f"{self.kind} {name!r} takes no argument {key!r}; {suggest(key, list(parameters))}")

    def __repr__(self) -> str:
        return f"Registry({self.slot!r}: {', '.join(self._factories)})"


BACKBONES = Registry("backbones", kind="backbone")
CANDIDATES = Registry("candidates", kind="candidates")
COSTS = Registry("costs", kind="cost")
GUIDANCE = Registry("guidance", kind="guidance")
AGGREGATIONS = Registry("aggregations", kind="aggregation")
REGRESSIONS = Registry("regressions", kind="regression")
UPSAMPLERS = Registry("upsamplers", kind="upsampler")
REFINEMENTS = Registry("refinements", kind="refinement")
LOSSES = Registry("losses", kind="loss")
MODELS = Registry("models", kind="model")
WEIGHTS = Registry("weights", kind="weights")

REGISTRIES = {
    registry.slot: registry
    for registry in (
        BACKBONES,
        CANDIDATES,
        COSTS,
        GUIDANCE,
        AGGREGATIONS,
        REGRESSIONS,
        UPSAMPLERS,
        REFINEMENTS,
        LOSSES,
        MODELS,
        WEIGHTS,
    )
}


def list_components(slot: str, pattern: str = "*") -> list[str]:
    """Names of the components that can fill a slot.

    Args:
        slot: "backbones", "candidates", "costs", "guidance", "aggregations", "regressions", "upsamplers",
            "refinements", "losses", "models" or "weights".
        pattern: shell-style wildcard.

    Raises:
        ConfigError: no such slot.

    >>> list_components("costs", "*correlation")
    ['correlation', 'groupwise_correlation']
    """
    if slot not in REGISTRIES:
        raise ConfigError(f"unknown slot {slot!r}; {suggest(slot, list(REGISTRIES))}")
    return REGISTRIES[slot].names(pattern)


def list_models(pattern: str = "*") -> list[str]:
    """Names that `build_model` knows.

    >>> list_models("psm*")
    ['psmnet']
    """
    return MODELS.names(pattern)


_plugins_loaded = False


def _load_plugins() -> None:
    """Imports what other packages declare, once; a broken plugin is a warning that names it."""
    global _plugins_loaded
    if _plugins_loaded:
        return
    _plugins_loaded = True
    for entry in entry_points(group=PLUGIN_GROUP):
        try:
            entry.load()
        except Exception as error:
            warnings.warn(
                f"stereokit plugin {entry.name!r} ({entry.value}) could not be loaded and is left out: "
                f"{type(error).__name__}: {error}",
                stacklevel=2,
            )
