"""PyTorch compiled by Inductor."""

import os
import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from stereokit.backends.eager import TorchBackend
from stereokit.backends.estimate import Estimate
from stereokit.errors import ConfigError
from stereokit.layers.casting import as_float
from stereokit.optimize import PreparedNetwork

__all__ = ["CompiledBackend", "compile_cache", "compile_network", "room_for_versions"]


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


def room_for_versions() -> AbstractContextManager[Any]:
    """Lets one network be compiled for as many kinds of sizes as come: at its limit the compiler gives up silently."""
    return cast(AbstractContextManager[Any], torch._dynamo.config.patch(recompile_limit=256))


class CompiledBackend(TorchBackend):
    """A network made ready for inference, as for `TorchBackend`, and compiled by `torch.compile`.

    The first size of images is compiled for that size alone, later ones for many sizes at once: a few times in all, by
    whether they need padding, for one. What was compiled is kept in `compile_cache`, so that later runs start faster.

    Args:
        network: see `TorchBackend`.
        device: of torch.
        precision: see `TorchBackend`.

    Raises:
        ConfigError: in `prepare`, where there is no compiler; see `TorchBackend` too.
    """

    name = "compile"

    def __init__(self, network: nn.Module, device: torch.device, precision: str | None = None) -> None:
        super().__init__(network, device, precision)
        self._seen: set[torch.Size] = set()

    def make_ready(self, network: PreparedNetwork) -> nn.Module:
        """Code that is compiled when it first runs."""
        self._seen.clear()
        return compile_network(network, self.device)

    def prepare(self, left: Tensor, right: Tensor) -> float:
        """Prepares the network, and compiles where images of this size were not seen before."""
        start = time.perf_counter()
        seconds = super().prepare(left, right)
        if left.shape in self._seen:
            return seconds
        try:
            # a CUDA graph is recorded at the second run
            for _ in range(3 if self.device.type == "cuda" else 1):
                self(left, right)
        except Exception as error:
            # it takes a second to import, and is loaded by now
            from torch._dynamo.exc import BackendCompilerFailed

            if not isinstance(error, BackendCompilerFailed | OSError):
                raise
            cause = getattr(error, "inner_exception", error)
            reason = str(cause).strip().split("\n")[0] or type(cause).__name__
            raise ConfigError(
                f"backend 'compile' can't compile here ({reason}): it needs a C++ compiler, and on a GPU Triton; "
                "use backend 'torch'"
            ) from error
        self._seen.add(left.shape)
        return time.perf_counter() - start

    def __call__(self, left: Tensor, right: Tensor) -> Estimate:
        """Images (B, 3, H, W) to disparity and confidence (B, H, W)."""
        # of one type, which is compiled once
        with room_for_versions():
            return super().__call__(*(as_float(images.to(self.device)).float() for images in (left, right)))
