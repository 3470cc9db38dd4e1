"""Which disparities a stage looks at."""

from stereokit.candidates.most_probable import MostProbable, most_probable
from stereokit.candidates.neighborhood import DisparityRange, NeighborhoodRange, spread_candidates
from stereokit.candidates.patch_match import PatchMatch, patch_match
from stereokit.candidates.uniform import UniformCandidates

__all__ = [
    "DisparityRange",
    "MostProbable",
    "NeighborhoodRange",
    "PatchMatch",
    "UniformCandidates",
    "most_probable",
    "patch_match",
    "spread_candidates",
]
