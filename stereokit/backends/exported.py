"""What the runtimes of exported files have in common."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from os import PathLike, fspath
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from stereokit.backends.estimate import Estimate
from stereokit.backends.metadata import ExportMetadata
from stereokit.builder import build_model
from stereokit.errors import ConfigError, InputError
from stereokit.layers.casting import as_float
from stereokit.network import check_least_size
from stereokit.runtime.memory import estimate_memory

__all__ = ["ExportedBackend"]


class ExportedBackend(ABC):
    """A file that `stereokit export` wrote, in the runtime that reads it.

    The file takes one pair of float32 images in [0, 1] at a time; batches pass through it pair by pair.
    """

    name: str
    metadata: ExportMetadata
    precision: str
    memory_share: float
    """The memory that a pair takes, in parts of what `estimate_memory` finds for PyTorch, at most."""
    memory_shares: Mapping[str, float] = MappingProxyType({})
    """Smaller ones, by the name of the network's aggregation."""

    def __init__(self, path: str | PathLike[str], device: torch.device) -> None:
        self.path = fspath(path)
        self.device = device

    @abstractmethod
    def run(self, left: npt.NDArray[np.float32], right: npt.NDArray[np.float32]) -> list[npt.NDArray[np.float32]]:
        """One pair (1, 3, H, W) through the file, to its outputs (1, H, W)."""

    def prepare(self, left: Tensor, right: Tensor) -> float:
        """Nothing is needed: the file was compiled when it was opened."""
        return 0.0

    def __call__(self, left: Tensor, right: Tensor) -> Estimate:
        """Images (B, 3, H, W) to disparity and confidence (B, H, W).

        Raises:
            InputError: the file was exported for another size.
        """
        self._check_size(*left.shape[-2:])
        lefts, rights = (as_float(x).to("cpu", torch.float32).numpy() for x in (left, right))
        outputs = [self.run(a[None], b[None]) for a, b in zip(lefts, rights, strict=True)]
        disparity, *confidence = (np.concatenate(maps) for maps in zip(*outputs, strict=True))
        return Estimate(disparity, confidence[0] if confidence else None).checked(left)

    def describe(self) -> dict[str, Any]:
        """What the file says of itself, in plain JSON."""
        return {"configuration": self.metadata.network, "export": self.metadata.to_dict()}

    def as_module(self) -> nn.Module:
        """The network in the file as a module, with random weights.

        Raises:
            ConfigError: the file is for one size alone, or its network was composed by hand, or of components that
                are not registered here.
        """
        if self.metadata.size is not None or self.metadata.network is None:
            reason = "was exported for one size alone" if self.metadata.size else "does not name its components"
            raise ConfigError(
                f"pairs can't be held to limits of memory with {self.path!r}, which {reason}; "
                "use a file of a registered network, exported without a size"
            )
        # the random weights are nobody's, and so is their draw
        with torch.random.fork_rng(devices=[]):
            network = build_model(dict(self.metadata.network))
        return network.eval()

    def estimate_memory(self, network: nn.Module, height: int, width: int) -> int:
        """The memory in bytes that a pair takes at most, from what PyTorch takes for the `network` of `as_module`."""
        aggregation = (self.metadata.network or {}).get("aggregation", {}).get("name")
        share = self.memory_shares.get(aggregation, self.memory_share)
        return int(share * estimate_memory(network, height, width))

    def _check_size(self, height: int, width: int) -> None:
        check_least_size(height, width)
        if self.metadata.size is not None and (height, width) != self.metadata.size:
            fixed_height, fixed_width = self.metadata.size
            raise InputError(
                f"the images are {width} x {height} pixels, but {self.path!r} was exported for {fixed_width} x "
                f"{fixed_height} alone; export it again without a size, or with --size {height} {width}"
            )
