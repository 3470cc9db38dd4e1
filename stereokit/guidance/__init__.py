"""Ways in which image features guide the aggregation of a cost volume."""

from stereokit.guidance.affinity import AffinityGuidance
from stereokit.guidance.excitation import GCE, AdditiveGuidance, ScalingGuidance, excite
from stereokit.guidance.multi_scale_attention import MSCA
from stereokit.guidance.neighborhood import NeighborhoodAggregation, neighborhood_sum
from stereokit.guidance.point import GuidancePlan, GuidancePoint, NoGuidance
from stereokit.guidance.semi_global import SemiGlobalGuidance, semi_global_aggregate

__all__ = [
    "GCE",
    "MSCA",
    "AdditiveGuidance",
    "AffinityGuidance",
    "GuidancePlan",
    "GuidancePoint",
    "NeighborhoodAggregation",
    "NoGuidance",
    "ScalingGuidance",
    "SemiGlobalGuidance",
    "excite",
    "neighborhood_sum",
    "semi_global_aggregate",
]
