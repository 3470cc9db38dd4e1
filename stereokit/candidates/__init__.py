"""Which disparities a stage looks at."""

from stereokit.candidates.neighborhood import DisparityRange, NeighborhoodRange, spread_candidates
from stereokit.candidates.uniform import UniformCandidates

__all__ = ["DisparityRange", "NeighborhoodRange", "UniformCandidates", "spread_candidates"]
