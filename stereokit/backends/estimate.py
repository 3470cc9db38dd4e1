"""What every backend takes and gives."""

from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from stereokit.contracts import StereoOutput
from stereokit.data.inputs import as_array
from stereokit.errors import InputError

__all__ = ["Backend", "Estimate"]


class Estimate(NamedTuple):
    """What a backend gives: arrays on the CPU."""

    disparity: npt.NDArray[np.float32]
    """(B, H, W), pixels of the left image."""
    confidence: npt.NDArray[np.float32] | None
    """(B, H, W) in [0, 1]; None if the network gives none."""

    @classmethod
    def of(cls, output: StereoOutput) -> "Estimate":
        """The disparity and the confidence of a network's output.

        Raises:
            InputError: it is something else, as a network of one's own may give.
        """
        if not isinstance(getattr(output, "disparity", None), Tensor) or not hasattr(output, "confidence"):
            raise InputError(
                f"the network gave a {type(output).__name__}; expected a StereoOutput, of disparity (B, H, W) in pixels"
            )
        confidence = None if output.confidence is None else as_array(output.confidence)
        return cls(as_array(output.disparity), confidence)

    def checked(self, images: Tensor) -> "Estimate":
        """Itself, if it is of the size of the images.

        Raises:
            InputError: it is of another, as that of a network of one's own or of a damaged file may be.
        """
        expected = (images.shape[0], *images.shape[-2:])
        for name, values in (("disparity", self.disparity), ("confidence", self.confidence)):
            if values is not None and values.shape != expected:
                raise InputError(f"the network gave a {name} of shape {values.shape}; expected {expected}")
        return self


class Backend(Protocol):
    """What runs a network: PyTorch as it is or compiled, or a runtime for exported files.

    Normalisation and padding are part of what it runs: it takes images as they are.
    """

    name: str
    """As `open_backend` knows it."""
    device: torch.device
    """Where it computes."""
    precision: str
    """Of the arithmetic: "float32", "bfloat16", "float16", or "int8" for a quantised file."""

    def prepare(self, left: Tensor, right: Tensor) -> float:
        """Does once what new weights, or images of a new size or type, need, such as compiling; the seconds it took."""

    def __call__(self, left: Tensor, right: Tensor) -> Estimate:
        """Matches images (B, 3, H, W), uint8 or float32 in [0, 1]; when it returns, the work is done.

        It runs what was prepared last; the first time it prepares by itself.
        """

    def describe(self) -> dict[str, Any]:
        """What it runs, in plain JSON."""
