"""Matching features of two views to a cost volume (B, C, D, H, W)."""

from stereokit.costs.combined import CombinedVolume
from stereokit.costs.concatenation import ConcatenationVolume, concatenation_volume
from stereokit.costs.correlation import (
    CorrelationVolume,
    GroupwiseCorrelationVolume,
    correlation_volume,
    groupwise_correlation_volume,
)
from stereokit.costs.difference import DifferenceVolume, difference_volume

__all__ = [
    "CombinedVolume",
    "ConcatenationVolume",
    "CorrelationVolume",
    "DifferenceVolume",
    "GroupwiseCorrelationVolume",
    "concatenation_volume",
    "correlation_volume",
    "difference_volume",
    "groupwise_correlation_volume",
]
