"""Cost volumes to logits over disparity."""

from stereokit.aggregation.encoder_decoder import EncoderDecoder
from stereokit.aggregation.guidance import (
    GCE,
    AdditiveGuidance,
    GuidancePoint,
    NeighborhoodAggregation,
    NoGuidance,
    excite,
    neighborhood_sum,
)
from stereokit.aggregation.hourglass import Hourglass
from stereokit.aggregation.stacked_hourglass import StackedHourglass

__all__ = [
    "GCE",
    "AdditiveGuidance",
    "EncoderDecoder",
    "GuidancePoint",
    "Hourglass",
    "NeighborhoodAggregation",
    "NoGuidance",
    "StackedHourglass",
    "excite",
    "neighborhood_sum",
]
