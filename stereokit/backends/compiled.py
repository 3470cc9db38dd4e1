"""PyTorch compiled by Inductor."""

import os
import time
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from stereokit.backends.eager import TorchBackend
from stereokit.model import StereoOutput

__all__ = ["CompiledBackend", "compile_cache"]


def compile_cache() -> Path:
    """The folder of compiled kernels, which outlives a run: TORCHINDUCTOR_CACHE_DIR, or one among the user's caches."""
    chosen = os.environ.get("TORCHINDUCTOR_CACHE_DIR")
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "stereokit" / "inductor"


class CompiledBackend(TorchBackend):
    """A network compiled by `torch.compile`, its weights frozen into the code.

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
        # Inductor's own default is a temporary folder, empty after a restart
        os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(compile_cache()))
        self._seen: set[tuple[Any, ...]] = set()
        # CUDA graphs take the launch of kernels off the CPU; on a CPU there is none to take off
        how: dict[str, Any] = {"mode": "reduce-overhead"} if device.type == "cuda" else {"options": {"freezing": True}}
        self._compiled = torch.compile(self.network, **how)

    def prepare(self, left: Tensor, right: Tensor) -> float:
        """Compiles, where images of this size and type were not seen before."""
        kind = (left.shape, left.dtype)
        if kind in self._seen:
            return 0.0
        start = time.perf_counter()
        self(left, right)
        self._seen.add(kind)
        return time.perf_counter() - start

    def forward(self, left: Tensor, right: Tensor) -> StereoOutput:
        """The compiled network on its device."""
        return cast(StereoOutput, self._compiled(left, right))
