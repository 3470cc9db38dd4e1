"""A small network as the library saves it, and one as its authors published it."""

import io
import re
import tempfile
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from stereokit import StereoNetwork, build_model
from stereokit.weights.key_map import PUBLISHED, KeyMap

__all__ = ["in_published_terms", "published_checkpoint", "save_tiny", "saved_network"]


def save_tiny(folder: str | Path) -> StereoNetwork:
    """A network of 1,713 parameters, which is built in a moment."""
    torch.manual_seed(0)
    network = build_model(
        "stereonet_8x",
        backbone={"name": "strided", "channels": 4, "halvings": 2, "blocks": 1},
        aggregation={"name": "plain", "channels": 4, "layers": 1},
        upsampler={"name": "bilinear"},
        refinements=[],
        max_disparity=32,
    )
    network.save_pretrained(folder)
    return network


@cache
def saved_network() -> dict[str, bytes]:
    """The files of `save_tiny`."""
    with tempfile.TemporaryDirectory() as folder:
        save_tiny(folder)
        return {name: (Path(folder) / name).read_bytes() for name in ("config.json", "model.safetensors")}


@cache
def published_checkpoint() -> bytes:
    """A CoEx with the published names and shapes, and one number for each of its weights."""
    with torch.device("meta"):
        shapes = build_model("coex").state_dict()
    [keys] = [published.keys for published in PUBLISHED if published.network == "coex"]
    # one number in the file stands for all of a tensor
    state = {key: torch.ones((), dtype=value.dtype).expand(value.shape) for key, value in shapes.items()}
    buffer = io.BytesIO()
    published = in_published_terms(state, keys)
    torch.save({"state_dict": {f"stereo.{key}": value for key, value in published.items()}}, buffer)
    return buffer.getvalue()


def in_published_terms(state: dict[str, Tensor], keys: KeyMap) -> dict[str, Tensor]:
    """The reverse of `KeyMap.rename`, for a whole state dict.

    Raises:
        ValueError: a key comes from no published one.
    """
    return {_published(key, keys): value for key, value in state.items()}


def _published(key: str, keys: KeyMap) -> str:
    for theirs, ours in keys:
        found = re.match(re.sub(r"\\\{(\w+)[^}]*\\\}", r"(?P<\1>\\d+)", re.escape(ours)), key)
        if found is None:
            continue
        shifts = {name: int(shift or 0) for name, shift in re.findall(r"\{(\w+)([+-]\d+)?\}", ours)}
        numbers = {name: int(value) - shifts[name] for name, value in found.groupdict().items()}
        # the first number of deconv8_4 is twice the second, and left out here
        rest = dict.fromkeys(set(re.findall(r"\{(\w+)\}", theirs)) - set(numbers), 2 * max(numbers.values(), default=1))
        candidate = theirs.format(**numbers, **rest) + key[found.end() :]
        if keys.rename(candidate) == key:
            return candidate
    raise ValueError(f"{key} comes from no published key")
