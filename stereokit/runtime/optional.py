"""Packages that only some users need, imported when they are used."""

import importlib
from types import ModuleType

from stereokit.errors import ConfigError

__all__ = ["import_optional"]

EXTRAS = {
    "onnx": "onnx",
    "onnxscript": "onnx",
    "onnxruntime": "onnx",
    "openvino": "openvino",
    "nncf": "openvino",
    "laspy": "las",
    "av": "video",
    "rosbags": "ros",
}
"""The extra of stereokit that installs a package."""


def import_optional(package: str, purpose: str) -> ModuleType:
    """Imports a package of one of the extras.

    Args:
        package: its name.
        purpose: what it is wanted for, for the message.

    Raises:
        ConfigError: it is not installed; the message names the extra that holds it.

    >>> import_optional("onnxruntime", "backend 'onnxruntime'").__name__  # doctest: +SKIP
    'onnxruntime'
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise ConfigError(
            f"{purpose} needs the package {package}, which can't be imported here ({error}); "
            f"pip install 'stereokit[{EXTRAS[package.partition('.')[0]]}]' installs it"
        ) from error
