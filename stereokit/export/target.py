"""What all formats do before they write."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import nn

from stereokit.errors import ConfigError, InputError
from stereokit.files import check_free

__all__ = ["check_target", "on_cpu"]


def check_target(path: str | os.PathLike[str], suffix: str, *, overwrite: bool) -> Path:
    """The path, if a file of the format can be written there; known before minutes are spent.

    Raises:
        InputError: it has another suffix, or exists already.

    >>> check_target("model.onnx", ".onnx", overwrite=False).name
    'model.onnx'
    """
    target = Path(path)
    if target.suffix.lower() != suffix:
        raise InputError(f"{os.fspath(path)!r} does not end in {suffix}, as files of this format do")
    check_free([target], overwrite=overwrite)
    if not target.absolute().parent.is_dir():
        raise InputError(f"{os.fspath(path)!r} can't be written: the folder {str(target.parent)!r} does not exist")
    return target


@contextmanager
def on_cpu(model: nn.Module) -> Iterator[nn.Module]:
    """The network in eval mode on the CPU; afterwards it is where and as it was."""
    if not isinstance(model, nn.Module):
        raise ConfigError(f"export takes a network; got {type(model).__name__}")
    first = next(iter((*model.parameters(), *model.buffers())), torch.empty(0))
    modes = {module: module.training for module in model.modules()}
    try:
        yield model.to("cpu").eval()
    finally:
        model.to(first.device)
        for module, training in modes.items():
            module.training = training
