"""Whether a pair can be matched, and what to do where it can't."""

from stereokit.cameras.checking.check import PairCheck, check_pair
from stereokit.cameras.checking.findings import Finding, Severity
from stereokit.cameras.checking.picture import matches_picture

__all__ = ["Finding", "PairCheck", "Severity", "check_pair", "matches_picture"]
