"""What a network can be run with, behind one door: see `Backend` and `open_backend`."""

from stereokit.backends.estimate import Backend, Estimate
from stereokit.backends.opening import BACKENDS, FILE_BACKENDS, is_exported, open_backend

__all__ = ["BACKENDS", "FILE_BACKENDS", "Backend", "Estimate", "is_exported", "open_backend"]
