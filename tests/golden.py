"""Recorded outputs of the published networks: weights are filled by rule, so only keys and shapes travel."""

import ast
import zlib
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from tests.shared import SHARED

GOLDEN = SHARED / "golden"


def place(file: str) -> Path:
    """Where a recording lies."""
    return GOLDEN / file if (GOLDEN / file).exists() else GOLDEN / "later" / file


def fill(shapes: dict[str, tuple[int, ...]], *, seed: int, norm: tuple[float, float]) -> dict[str, Tensor]:
    """A state dict, each tensor drawn by a generator that its key seeds."""
    state = {}
    for key, shape in shapes.items():
        rng = np.random.Generator(np.random.PCG64(zlib.crc32(key.encode()) + seed))
        leaf = key.rsplit(".", 1)[-1]
        if leaf == "num_batches_tracked":
            state[key] = torch.tensor(0)
            continue
        if len(shape) >= 2:
            value = rng.standard_normal(shape) * np.sqrt(2 / np.prod(shape[1:]))
        elif leaf == "running_var":
            value = rng.uniform(0.8, 1.2, shape)
        elif leaf == "weight":
            value = rng.uniform(*norm, shape)
        else:
            value = rng.standard_normal(shape) * 0.1
        state[key] = torch.from_numpy(np.asarray(value, np.float32))
    return state


def published_state(name: str, norm: tuple[float, float] = (0.8, 1.2), *, seed: int = 1) -> dict[str, Tensor]:
    """The state dict of a published network, by the name of its recording."""
    lines = place(f"{name}_keys.tsv").read_text().splitlines()
    shapes = {key: ast.literal_eval(shape) for key, shape in (line.split("\t") for line in lines if line)}
    return fill(shapes, seed=seed, norm=norm)


def recording(name: str) -> dict[str, Tensor]:
    """What the network computed: images (1, 3, H, W) and outputs."""
    with np.load(place(f"{name}_dev.npz")) as arrays:
        content = {key: torch.from_numpy(arrays[key]) for key in arrays.files}
    return {k: v.permute(2, 0, 1).unsqueeze(0) if k in ("left", "right") else v for k, v in content.items()}


def save_checkpoint(state: dict[str, Tensor], path: Path) -> Path:
    """A Lightning checkpoint, with the prefix of the authors' module."""
    torch.save({"epoch": 1, "state_dict": {f"stereo.{k}": v for k, v in state.items()}}, path)
    return path
