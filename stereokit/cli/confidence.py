"""What a low confidence tells of a pair."""

__all__ = ["noise_warning"]

NOISE = 0.6
"""Mean confidence of a pair below which it says so: good pairs have 0.8 and more, most views that do not match less."""


def noise_warning(name: str, confidence: float | None) -> str | None:
    """A line for a pair whose mean confidence is that of views that do not match; None for others."""
    if confidence is None or confidence >= NOISE:
        return None
    return f"{name}: mean confidence {confidence:.2f}, as of views that do not match; 'stereokit check' tells why"
