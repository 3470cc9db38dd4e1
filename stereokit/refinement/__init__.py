"""What mends a disparity in the end."""

from stereokit.refinement.edge_aware import EdgeAwareRefinement

__all__ = ["EdgeAwareRefinement"]
