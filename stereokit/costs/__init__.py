"""Matching features of two views to a cost volume (B, C, D, H, W)."""

from stereokit.costs.concatenation import ConcatenationVolume, concatenation_volume
from stereokit.costs.correlation import (
    CorrelationVolume,
    GroupwiseCorrelationVolume,
    correlation_volume,
    groupwise_correlation_volume,
)

__all__ = [
    "ConcatenationVolume",
    "CorrelationVolume",
    "GroupwiseCorrelationVolume",
    "concatenation_volume",
    "correlation_volume",
    "groupwise_correlation_volume",
]
