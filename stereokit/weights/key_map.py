"""Keys of published state dicts in our terms: tables of prefixes, one beside each network."""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

from torch import Tensor

from stereokit.errors import ConfigError

__all__ = ["PUBLISHED", "ChannelOrder", "KeyMap", "Published", "layer", "publish"]

ChannelOrder = Literal["bgr", "rgb"]

PLACEHOLDER = re.compile(r"\{(\w+)([+-]\d+)?\}")


class KeyMap:
    """Pairs of prefixes: a published key that begins with the first of a pair begins with the second one here.

    ``{n}`` stands for a number, which may be moved: ``("dres{n}.", "aggregation.hourglass{n-1}.")``. The first pair
    that matches counts, and what follows the prefix stays.

    Args:
        pairs: published prefix, and ours.

    >>> keys = KeyMap([("head.", "aggregation.head."), ("dres{n}.", "aggregation.hourglass{n-1}.")])
    >>> keys.rename("dres2.conv1.weight"), keys.rename("other.weight")
    ('aggregation.hourglass1.conv1.weight', None)
    """

    def __init__(self, pairs: Iterable[tuple[str, str]]) -> None:
        self.pairs = tuple(pairs)

    def __iter__(self) -> Iterator[tuple[str, str]]:
        """The pairs."""
        return iter(self.pairs)

    def under(self, published: str, ours: str) -> "KeyMap":
        """The same pairs, each behind a prefix.

        >>> list(KeyMap([("a.", "b.")]).under("net.", "backbone."))
        [('net.a.', 'backbone.b.')]
        """
        return KeyMap((published + theirs, ours + mine) for theirs, mine in self.pairs)

    def rename(self, key: str) -> str | None:
        """A published key in our terms; None where it has no place."""
        for pattern, ours in self._compiled:
            if found := pattern.match(key):
                return _filled(ours, found.groupdict()) + key[found.end() :]
        return None

    @cached_property
    def _compiled(self) -> list[tuple[re.Pattern[str], str]]:
        return [(_as_pattern(theirs), ours) for theirs, ours in self.pairs]


def layer(published: str, ours: str) -> KeyMap:
    """A `ConvNormAct`, whose parts are numbered here and named there.

    >>> list(layer("spx.0.", "upsampler.stem.0."))
    [('spx.0.conv.', 'upsampler.stem.0.0.'), ('spx.0.bn.', 'upsampler.stem.0.1.')]
    """
    return KeyMap([(f"{published}conv.", f"{ours}0."), (f"{published}bn.", f"{ours}1.")])


@dataclass(frozen=True)
class Published:
    """What has to be known of a published network to load its checkpoints.

    Args:
        network: the registered name.
        source: where the format is from.
        licence: of that source.
        keys: where each weight goes.
        images: channel order of the images that the authors trained on.
        first_layers: keys of ours whose weights see the image in their first three channels, which are turned around
            for "bgr".
        negated: prefixes of published keys whose values change their sign: lower is better there, or flow to the left.
        unused: prefixes of published keys that the published forward pass never reaches.
        overrides: of `build_model`, for what the published network does otherwise than ours by default.
        variant: reads further overrides off a state dict.
        convert: changes a state dict of ours where a table can't say it.
    """

    network: str
    source: str
    licence: str
    keys: KeyMap
    images: ChannelOrder = "rgb"
    first_layers: tuple[str, ...] = ()
    negated: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    overrides: Mapping[str, Any] = field(default_factory=dict)
    variant: Callable[[Mapping[str, Tensor]], dict[str, Any]] | None = None
    convert: Callable[[dict[str, Tensor]], dict[str, Tensor]] | None = None

    def is_unused(self, key: str) -> bool:
        """Whether the published network never reads this weight."""
        return any(pattern.match(key) for pattern in self._unused)

    def left_over(self, state: Mapping[str, Tensor]) -> list[str]:
        """The keys that have no place."""
        return [key for key in state if not self.is_unused(key) and self.keys.rename(key) is None]

    @cached_property
    def _unused(self) -> list[re.Pattern[str]]:
        return [_as_pattern(prefix) for prefix in self.unused]


PUBLISHED: list[Published] = []
"""All formats that are known, in the order of their registration."""


def publish(network: str, *, source: str, licence: str, keys: Iterable[tuple[str, str]], **rest: Any) -> Published:
    """Makes a published format known, see `Published` for the arguments.

    Raises:
        ConfigError: it is known already.
    """
    published = Published(network, source, licence, KeyMap(keys), **rest)
    if any((other.network, other.source) == (network, source) for other in PUBLISHED):
        raise ConfigError(f"the format of {network!r} from {source} is known already")
    PUBLISHED.append(published)
    return published


def _as_pattern(prefix: str) -> re.Pattern[str]:
    parts, end = [], 0
    for found in PLACEHOLDER.finditer(prefix):
        parts += [re.escape(prefix[end : found.start()]), rf"(?P<{found[1]}>\d+)"]
        end = found.end()
    return re.compile("".join([*parts, re.escape(prefix[end:])]))


def _filled(ours: str, numbers: Mapping[str, str]) -> str:
    return PLACEHOLDER.sub(lambda found: str(int(numbers[found[1]]) + int(found[2] or 0)), ours)
