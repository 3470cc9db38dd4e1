"""Stereo matching components: blocks registered by name, and a builder that composes them into networks."""

from stereokit._version import __version__
from stereokit.errors import CheckpointError, ConfigError, InputError, StereoKitError

__all__ = ["CheckpointError", "ConfigError", "InputError", "StereoKitError", "__version__"]
