"""What a network can be run with, behind one door: see `Backend` and `open_backend`."""

from stereokit.backends.estimate import Backend, Estimate
from stereokit.backends.opening import BACKENDS, open_backend

__all__ = ["BACKENDS", "Backend", "Estimate", "open_backend"]
