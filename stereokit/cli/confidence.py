"""What a low confidence tells of a pair."""

import numpy as np

from stereokit.inference import DisparityResult

__all__ = ["noise_warning"]

NOISE = 0.6
"""Mean confidence of a pair below which it says so: good pairs have 0.8 and more, most views that do not match less."""


def noise_warning(name: str, result: DisparityResult) -> str | None:
    """A line for a pair whose mean confidence is that of views that do not match; None for others."""
    known = np.isfinite(result.disparity)
    if result.confidence is None or not known.any():
        return None
    confidence = result.confidence[known].mean()
    if confidence >= NOISE:
        return None
    return f"{name}: mean confidence {confidence:.2f}, as of views that do not match; 'stereokit check' tells why"
