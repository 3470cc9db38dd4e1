"""What kind of place a network lies at, going by its name."""

import os
import re
from pathlib import Path

from stereokit.errors import CheckpointError

__all__ = ["FILE_BACKENDS", "check_no_program", "is_exported", "is_hub_id"]

FILE_BACKENDS = {".onnx": "onnxruntime", ".xml": "openvino"}
"""What runs an exported file, by its suffix."""

HUB_ID = re.compile(r"\w[\w.-]*/\w[\w.-]*")


def is_exported(place: object) -> bool:
    """Whether this is the path of an exported file, going by its suffix.

    >>> is_exported("model.onnx"), is_exported("saved_network")
    (True, False)
    """
    return isinstance(place, str | os.PathLike) and Path(place).suffix.lower() in FILE_BACKENDS


def check_no_program(path: str) -> None:
    """Raises `CheckpointError` for a file with a program of `torch.export`, going by its suffix: no backend runs it."""
    if Path(path).suffix.lower() == ".pt2" and os.path.isfile(path):
        raise CheckpointError(
            f"{path!r} is a program of torch.export, which torch.export.load reads; Predictor takes exported files "
            f"that end in {' or '.join(FILE_BACKENDS)}, or the network itself"
        )


def is_hub_id(name: str) -> bool:
    """Whether this has the form of a repository of the Hugging Face hub, which alone the hub is asked for.

    >>> is_hub_id("owner/name"), is_hub_id("coex"), is_hub_id("./runs")
    (True, False, False)
    """
    return HUB_ID.fullmatch(name) is not None
