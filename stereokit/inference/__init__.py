"""From a pair of images to a disparity map: the predictor, and pairs that are not matched as they are."""

from stereokit.inference.bounds import BoundedMatcher, MemoryPlan, TooLarge
from stereokit.inference.distributions import Distributions, PixelDistributions, find_distributions
from stereokit.inference.predictor import Predictor
from stereokit.inference.result import DisparityResult, output_paths
from stereokit.inference.scaling import MAX_SCALE, Run, match_scaled, scaled_size
from stereokit.inference.tiles import match_tiles, tile_grid
from stereokit.inference.video import FrameResult, match_video

__all__ = [
    "MAX_SCALE",
    "BoundedMatcher",
    "DisparityResult",
    "Distributions",
    "FrameResult",
    "MemoryPlan",
    "PixelDistributions",
    "Predictor",
    "Run",
    "TooLarge",
    "find_distributions",
    "match_scaled",
    "match_tiles",
    "match_video",
    "output_paths",
    "scaled_size",
    "tile_grid",
]
