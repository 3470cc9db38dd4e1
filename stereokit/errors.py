"""The errors a user of stereokit can meet, one family.

Each message says what was given, what was expected and what would work. The command line prints the message as
one line and exits with 2.
"""

__all__ = ["CheckpointError", "ConfigError", "InputError", "StereoKitError"]


class StereoKitError(Exception):
    """Base of all errors that stereokit raises on purpose.

    >>> from stereokit import build_model
    >>> try:
    ...     build_model("coexx")
    ... except StereoKitError as error:
    ...     print(str(error).split(";")[0])
    unknown model 'coexx'
    """


class ConfigError(StereoKitError, ValueError):
    """A network that can't be composed: unknown names, unknown arguments, neighbours that do not fit."""


class InputError(StereoKitError, ValueError):
    """Images, tensors or data files that can't be used: unreadable, of the wrong shape, type or range."""


class CheckpointError(StereoKitError, ValueError):
    """Weights that can't be loaded: truncated, of another network, or a pickle that would run code."""
