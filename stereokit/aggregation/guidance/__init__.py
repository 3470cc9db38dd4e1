"""Ways in which image features guide the aggregation of a cost volume."""

from stereokit.aggregation.guidance.excitation import GCE, AdditiveGuidance, excite
from stereokit.aggregation.guidance.neighborhood import NeighborhoodAggregation, neighborhood_sum
from stereokit.aggregation.guidance.point import GuidancePlan, GuidancePoint, NoGuidance

__all__ = [
    "GCE",
    "AdditiveGuidance",
    "GuidancePlan",
    "GuidancePoint",
    "NeighborhoodAggregation",
    "NoGuidance",
    "excite",
    "neighborhood_sum",
]
