"""The types of what a recipe or a machine is given, checked by the annotations of its fields."""

import math
import types
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Literal, Union, get_args, get_origin

from stereokit.errors import ConfigError

__all__ = ["brief", "check_fields", "check_types", "check_unused", "is_number"]

_WORDS: dict[Any, str] = {
    bool: "true or false",
    int: "a whole number",
    float: "a finite number",
    str: "text",
    type(None): "nothing",
}


def check_fields(section: str, settings: Any) -> None:
    """Sees that each field of a dataclass holds what its annotation says.

    Raises:
        ConfigError: one does not; the message names it, what was given and what is expected.

    >>> from dataclasses import dataclass
    >>> @dataclass
    ... class Length:
    ...     steps: int
    >>> check_fields("length", Length(steps=2.5))
    Traceback (most recent call last):
    stereokit.errors.ConfigError: length: steps is 2.5; expected a whole number
    """
    annotations = {field.name: field.type for field in fields(settings)}
    check_types(section, {name: getattr(settings, name) for name in annotations}, annotations)


def check_types(section: str, values: Mapping[str, Any], annotations: Mapping[str, Any]) -> None:
    """Sees that values are of the types that are annotated, number by number in lists; other keys are left alone.

    bool is no number, inf and NaN are none either. A table, and what is annotated as anything, holds plain values:
    text, numbers, true or false, lists and tables of them, as JSON keeps them.

    Raises:
        ConfigError: see `check_fields`.
    """
    for key, value in values.items():
        if key not in annotations:
            continue
        if not _fits(value, annotations[key]):
            raise ConfigError(f"{section}: {key} is {brief(value)}; expected {_in_words(annotations[key])}")
        # a class of its own checks what it holds
        own = get_origin(annotations[key]) is None and isinstance(annotations[key], type)
        if not own and (odd := _not_plain(value, key)) is not None:
            place, part = odd
            raise ConfigError(
                f"{section}: {place} is {brief(part)}; expected text, a finite number, true or false, or a list or "
                "table of these"
            )


def check_unused(section: str, settings: Any, kind: str, used: Mapping[str, Sequence[str]]) -> None:
    """Refuses fields that differ from their defaults and have no effect with a kind.

    Args:
        section: for the message.
        settings: a dataclass.
        kind: the one that was chosen.
        used: of each kind the fields that only some kinds use.
    """
    defaults = {field.name: field.default for field in fields(settings)}
    for name in dict.fromkeys(name for names in used.values() for name in names):
        given = getattr(settings, name)
        if name not in used[kind] and given != defaults[name]:
            others = " or ".join(repr(other) for other, names in used.items() if name in names)
            raise ConfigError(
                f"{section}: {name} = {brief(given)} has no effect with kind {kind!r}; leave it out, or choose kind "
                f"{others}"
            )


def is_number(value: Any) -> bool:
    """Whether a value is a finite int or float, and no bool."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _fits(value: Any, wanted: Any) -> bool:
    origin, parts = get_origin(wanted), get_args(wanted)
    if wanted is Any:
        return True
    if origin in (Union, types.UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin is tuple:
        if not isinstance(value, list | tuple):
            return False
        kinds = [parts[0]] * len(value) if parts[-1] is ... else parts
        return len(value) == len(kinds) and all(map(_fits, value, kinds))
    if wanted is float:
        return is_number(value)
    if wanted is int:
        return is_number(value) and isinstance(value, int)
    return isinstance(value, origin or wanted)


def _in_words(wanted: Any) -> str:
    origin, parts = get_origin(wanted), get_args(wanted)
    if origin in (Union, types.UnionType):
        # a field that may be left out
        return " or ".join(_in_words(part) for part in parts if part is not type(None))
    if origin is Literal:
        *most, last = map(repr, parts)
        return f"{', '.join(most)} or {last}"
    if origin is tuple:
        count = "" if parts[-1] is ... else f"{len(parts)} "
        return f"a list of {count}{_in_words(parts[0]).removeprefix('a ')}s"
    return _WORDS.get(wanted) or ("a table" if origin is not None else wanted.__name__)


def _not_plain(value: Any, place: str) -> tuple[str, Any] | None:
    """The first part of a value that is no plain one, and where it is."""
    if value is None or isinstance(value, str | bool) or is_number(value):
        return None
    if isinstance(value, Mapping):
        parts = [(f"{place}.{key}", part) for key, part in value.items()]
    elif isinstance(value, list | tuple):
        parts = [(f"{place}[{index}]", part) for index, part in enumerate(value)]
    else:
        return place, value
    return next((odd for name, part in parts if (odd := _not_plain(part, name)) is not None), None)


def brief(value: Any, most: int = 80) -> str:
    """A value for a message, cut where it is longer than so many characters."""
    text = " ".join(repr(value).split())
    return text if len(text) <= most else f"{text[:most]}..."
