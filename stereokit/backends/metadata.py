"""What an exported file says of itself."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from torch import nn

from stereokit._version import __version__
from stereokit.errors import CheckpointError, ConfigError

__all__ = ["FORMAT", "KEY", "ExportMetadata", "describe_network"]

KEY = "stereokit"
"""Where it stands: ONNX's metadata_props, OpenVINO's rt_info, and `stereokit` among the extra files of a program."""

FORMAT = 1
"""Of exported files; one more whenever a reader of the former one would go wrong."""


def describe_network(model: nn.Module) -> dict[str, Any]:
    """What a network can tell of itself: `network` and `max_disparity` of `ExportMetadata`.

    >>> describe_network(nn.Identity())
    {'network': None, 'max_disparity': None}
    """
    try:
        network = model.config
    except (AttributeError, ConfigError):
        # composed by hand
        network = None
    return {"network": network, "max_disparity": getattr(model, "max_disparity", None)}


@dataclass(frozen=True)
class ExportMetadata:
    """Stored as JSON inside the file.

    Args:
        network: its configuration, see `ModelConfig`; None if it was composed by hand.
        max_disparity: D, in pixels; None if the network does not say.
        size: height and width of the images; None for any.
        precision: "float32", "bfloat16" or "int8".
        opset: of ONNX; None for other formats.
        stereokit_version: that wrote the file.
        format: see `FORMAT`.

    >>> metadata = ExportMetadata(network=None, max_disparity=192, size=(384, 1248))
    >>> ExportMetadata.read({KEY: metadata.to_json()}, "model.onnx") == metadata
    True
    """

    network: Mapping[str, Any] | None
    max_disparity: int | None
    size: tuple[int, int] | None = None
    precision: str = "float32"
    opset: int | None = None
    stereokit_version: str = __version__
    format: int = FORMAT

    def to_dict(self) -> dict[str, Any]:
        """In plain JSON."""
        return {**asdict(self), "size": None if self.size is None else list(self.size)}

    def to_json(self) -> str:
        """What is stored."""
        return json.dumps(self.to_dict())

    @classmethod
    def read(cls, properties: Mapping[str, str], path: str) -> "ExportMetadata":
        """From the properties of a file.

        Raises:
            CheckpointError: stereokit did not write the file, or a newer version with another format did.
        """
        if KEY not in properties:
            raise CheckpointError(
                f"{path!r} was not written by stereokit: it does not say what it holds; "
                "stereokit export writes files that do"
            )
        try:
            stored = json.loads(properties[KEY])
            written, version = int(stored["format"]), str(stored["stereokit_version"])
            if written <= FORMAT:
                size = stored["size"]
                return cls(**{**stored, "size": None if size is None else (int(size[0]), int(size[1]))})
        except (ValueError, TypeError, KeyError, IndexError, OverflowError, RecursionError) as error:
            raise CheckpointError(f"{path!r} is damaged: what it says of itself can't be read ({error})") from error
        raise CheckpointError(
            f"{path!r} was written by stereokit {version} in format {written}; this is stereokit {__version__}, which "
            f"reads formats up to {FORMAT}: update stereokit, or export the network again"
        )
