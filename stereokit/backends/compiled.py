"""PyTorch compiled by Inductor."""

import os
import time
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from stereokit.backends.eager import TorchBackend
from stereokit.optimize import PreparedNetwork

__all__ = ["CompiledBackend", "compile_cache", "compile_network"]


def compile_cache() -> Path:
    """The folder of compiled kernels, which outlives a run: TORCHINDUCTOR_CACHE_DIR, or one among the user's caches."""
    chosen = os.environ.get("TORCHINDUCTOR_CACHE_DIR")
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stereokit" / "inductor"


def compile_network(network: PreparedNetwork, device: torch.device, **options: Any) -> nn.Module:
    """A prepared network through `torch.compile`, which keeps what it makes in `compile_cache`.

    Args:
        network: on the device.
        device: of torch.
        options: of `torch.compile`.
    """
    # Inductor's own default is a temporary folder, empty after a restart
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(compile_cache()))
    # CUDA graphs take the launch of kernels off the CPU; on a CPU there is none to take off
    mode = "reduce-overhead" if device.type == "cuda" else None
    return cast(nn.Module, torch.compile(network, mode=mode, **options))


class CompiledBackend(TorchBackend):
    """A network made ready for inference, as for `TorchBackend`, and compiled by `torch.compile`.

    The first size of images is compiled for that size alone; the second one, for any. What was compiled is kept
    in `compile_cache`, so that later runs start faster.

    Args:
        network: see `TorchBackend`.
        device: of torch.
        precision: see `TorchBackend`.
    """

    name = "compile"

    def __init__(self, network: nn.Module, device: torch.device, precision: str | None = None) -> None:
        super().__init__(network, device, precision)
        self._seen: set[tuple[Any, ...]] = set()

    def make_ready(self, network: PreparedNetwork) -> nn.Module:
        """Code that is compiled when it first runs."""
        self._seen.clear()
        return compile_network(network, self.device)

    def prepare(self, left: Tensor, right: Tensor) -> float:
        """Prepares the network, and compiles where images of this size and type were not seen before."""
        start = time.perf_counter()
        seconds = super().prepare(left, right)
        kind = (left.shape, left.dtype)
        if kind in self._seen:
            return seconds
        # a CUDA graph is recorded at the second run
        for _ in range(3 if self.device.type == "cuda" else 1):
            self(left, right)
        self._seen.add(kind)
        return time.perf_counter() - start
