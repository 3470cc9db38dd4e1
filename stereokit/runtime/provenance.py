"""What a number or a network was made on and with, so that it can be repeated."""

import hashlib
import os
import platform
import subprocess
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from stereokit._version import __version__
from stereokit.errors import InputError

__all__ = ["commit", "file_sha256", "machine", "state_sha256", "versions"]

PACKAGES = (
    "torch",
    "numpy",
    "opencv-python-headless",
    "opencv-python",
    "timm",
    "lightning",
    "einops",
    "safetensors",
    "onnx",
    "onnxscript",
    "onnxruntime",
    "onnxruntime-gpu",
    "openvino",
    "nncf",
)


def file_sha256(path: str | os.PathLike[str]) -> str:
    """The SHA-256 of a file's content, as `sha256sum` gives it.

    Raises:
        InputError: the file can't be read.
    """
    digest = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            while block := file.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise InputError(f"{os.fspath(path)!r} can't be read: {error.strerror or error}") from error
    return digest.hexdigest()


def state_sha256(state: Mapping[str, Tensor]) -> str:
    """The SHA-256 of weights: names, types, shapes and values in the order of names, whatever file they came from.

    >>> state = {"a": torch.zeros(2), "b": torch.ones(1)}
    >>> state_sha256(state) == state_sha256(dict(reversed(state.items())))
    True
    """
    digest = hashlib.sha256()
    for name in sorted(state):
        value = state[name].detach().cpu().contiguous()
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        digest.update(value.flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def machine() -> dict[str, Any]:
    """The computer, and the settings of torch that change times or last digits."""
    parts: dict[str, Any] = {
        "system": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "torch_threads": torch.get_num_threads(),
        "float32_matmul_precision": torch.get_float32_matmul_precision(),
        "cudnn_benchmark": torch.backends.cudnn.benchmark,
        "cudnn_allow_tf32": torch.backends.cudnn.allow_tf32,
        "accelerators": [],
    }
    if torch.cuda.is_available():
        parts["accelerators"] = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
        parts["cuda"], parts["cudnn"] = torch.version.cuda, torch.backends.cudnn.version()  # type: ignore[no-untyped-call]
    elif torch.accelerator.is_available():
        parts["accelerators"] = [str(torch.accelerator.current_accelerator())]
    return parts


def versions() -> dict[str, str]:
    """The versions of Python, this library and those that numbers may depend on."""
    found = {"python": platform.python_version(), "stereokit": __version__}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def commit() -> str | None:
    """The commit of the source tree that this library is run from, "-dirty" behind it if files differ; None if it is
    installed.
    """
    source = Path(__file__).parents[2]
    if not (source / ".git").exists():
        return None
    git = ["git", "-C", str(source)]
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
        changed = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    return f"{head}-dirty" if changed.strip() else head


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            for line in file:
                if line.startswith("model name"):
                    return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
