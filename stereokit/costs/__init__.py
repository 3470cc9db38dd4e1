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
from stereokit.costs.interlaced import InterlacedVolume, interlaced_volume
from stereokit.costs.matching_network import MatchingNetwork
from stereokit.costs.pair_lookup import PairLookup, correlation_pyramid, look_up, look_up_on_demand
from stereokit.costs.signed_correlation import SignedCorrelation, signed_correlation
from stereokit.costs.volume_lookup import VolumeLookup, look_up_volume, volume_pyramid
from stereokit.costs.warped_correlation import WarpedCorrelation, warped_correlation

__all__ = [
    "CombinedVolume",
    "ConcatenationVolume",
    "CorrelationVolume",
    "DifferenceVolume",
    "GroupwiseCorrelationVolume",
    "InterlacedVolume",
    "MatchingNetwork",
    "PairLookup",
    "SignedCorrelation",
    "VolumeLookup",
    "WarpedCorrelation",
    "concatenation_volume",
    "correlation_pyramid",
    "correlation_volume",
    "difference_volume",
    "groupwise_correlation_volume",
    "interlaced_volume",
    "look_up",
    "look_up_on_demand",
    "look_up_volume",
    "signed_correlation",
    "volume_pyramid",
    "warped_correlation",
]
