"""Disparity from depth, for data sets that keep depth."""

import numpy as np
import numpy.typing as npt

from stereokit.data.disparity_arrays import Disparity

__all__ = ["disparity_from_depth"]


def disparity_from_depth(depth: npt.NDArray[np.floating], *, fx: float, baseline: float) -> Disparity:
    """Disparity of two views that look in parallel, d = fx * baseline / Z.

    Args:
        depth: Z along the optical axis, of any shape; 0, negative or not finite where unknown.
        fx: focal length in pixels.
        baseline: in the unit of the depth.

    Returns:
        Pixels, of the same shape, NaN where unknown.

    >>> disparity_from_depth(np.array([2.0, 0.0]), fx=320, baseline=0.25).tolist()
    [40.0, nan]
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        disparity = (fx * baseline / depth.astype(np.float64)).astype(np.float32)
    disparity[~(np.isfinite(depth) & (depth > 0))] = np.nan
    return disparity
