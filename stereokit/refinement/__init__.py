"""What mends a disparity in the end."""

from stereokit.refinement.edge_aware import EdgeAwareRefinement
from stereokit.refinement.warped import WarpedRefinement

__all__ = ["EdgeAwareRefinement", "WarpedRefinement"]
