"""What a check can find."""

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

__all__ = ["SEVERITIES", "Finding", "Severity"]

Severity: TypeAlias = Literal["good", "warning", "unusable"]

SEVERITIES: tuple[Severity, ...] = ("good", "warning", "unusable")
"""From best to worst."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a pair.

    Attributes:
        name: a word that stays the same, for programs: "swapped", "roll", "range", ...
        severity: "warning", the result will be poorer; "unusable", it will be wrong.
        message: what was seen, and what to do.
    """

    name: str
    severity: Severity
    message: str

    def to_dict(self) -> dict[str, Any]:
        """The finding as plain values, ready for JSON."""
        return {"name": self.name, "severity": self.severity, "message": self.message}
