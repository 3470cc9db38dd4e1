"""What the library's own JSON files share: a format, a version, and numbers that are checked."""

from collections.abc import Mapping
from typing import Any, TypeGuard

from stereokit.errors import InputError

__all__ = ["check_version", "is_count", "read_number"]


def check_version(values: Mapping[str, Any], kind: str, newest: int) -> None:
    """Raises `InputError` unless a file's content says that it is of this kind, in a version that is known."""
    if values.get("format") != kind:
        raise InputError(f"expected the format {kind!r}, got {str(values.get('format'))[:80]!r}")
    version = values.get("version")
    if not is_count(version) or version > newest:
        raise InputError(
            f"the {kind} has version {str(version)[:40]}; this release reads up to {newest}, a newer one may read it"
        )


def read_number(values: Mapping[str, Any], key: str) -> float:
    """The number of an entry; raises `InputError` where there is none."""
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        raise InputError(f"expected a number for {key}, got {str(value)[:80]}")
    return float(value)


def is_count(value: Any) -> TypeGuard[int]:
    """Whether a value is a positive whole number that could count pixels."""
    return isinstance(value, int) and not isinstance(value, bool) and 0 < value < 10**9
