"""Which backend runs what."""

import os
from pathlib import Path

import torch
from torch import nn

from stereokit.backends.compiled import CompiledBackend
from stereokit.backends.eager import TorchBackend
from stereokit.backends.estimate import Backend
from stereokit.errors import CheckpointError, ConfigError
from stereokit.registry import suggest
from stereokit.weights.places import FILE_BACKENDS

__all__ = ["BACKENDS", "open_backend"]

TORCH_BACKENDS = {"torch": TorchBackend, "compile": CompiledBackend}
BACKENDS = (*TORCH_BACKENDS, *FILE_BACKENDS.values())
"""All names, besides "auto"."""


def open_backend(
    model: nn.Module | str | os.PathLike[str],
    device: str | torch.device,
    backend: str = "auto",
    precision: str | None = None,
) -> Backend:
    """Makes ready what runs a network.

    Args:
        model: a network, or the path of an exported file.
        device: as the backend takes it.
        backend: one of `BACKENDS`, or "auto": that of the file's suffix, and "torch" for a network.
        precision: of the arithmetic; float32, or that of the file, by default.

    Raises:
        ConfigError: an unknown backend, one that does not run this, or one that is not installed.
        CheckpointError: the file does not exist, or can't be used.

    >>> from stereokit import build_model
    >>> open_backend(build_model("coex", max_disparity=64), torch.device("cpu")).name
    'torch'
    """
    check_backend(backend)
    if isinstance(model, nn.Module):
        if backend in FILE_BACKENDS.values():
            [suffix] = [s for s, name in FILE_BACKENDS.items() if name == backend]
            raise ConfigError(
                f"backend {backend!r} runs exported files; write one first, with stereokit export --to "
                f"{'onnx' if suffix == '.onnx' else 'openvino'}, and give its path, which ends in {suffix}"
            )
        return TORCH_BACKENDS["torch" if backend == "auto" else backend](model, torch.device(device), precision)
    path = os.fspath(model)
    named = FILE_BACKENDS[Path(path).suffix.lower()]
    if backend not in ("auto", named):
        raise ConfigError(f"{path!r} is run by backend {named!r}, not {backend!r}; use 'auto'")
    if not os.path.isfile(path):
        raise CheckpointError(f"the exported file {path!r} does not exist")
    # these import what reads the file, which not everybody has
    if named == "onnxruntime":
        from stereokit.backends.onnxruntime import OnnxRuntimeBackend

        return OnnxRuntimeBackend(path, device, precision)
    from stereokit.backends.openvino import OpenVinoBackend

    return OpenVinoBackend(path, device, precision)


def check_backend(backend: str) -> None:
    """Raises `ConfigError` for an unknown name."""
    if backend not in ("auto", *BACKENDS):
        raise ConfigError(f"unknown backend {backend!r}; {suggest(str(backend), ['auto', *BACKENDS])}")
