"""What a network costs: parameters and multiply-adds, block by block."""

import copy
from dataclasses import dataclass
from typing import Any

import torch

from stereokit.model import StereoModel

__all__ = ["BlockCost", "model_summary"]


@dataclass(frozen=True)
class BlockCost:
    """One block of a network.

    Args:
        slot: where it stands.
        name: its registered name.
        kind: its class.
        parameters: learned numbers.
        multiply_adds: of convolutions and matrix products, for one pair.
    """

    slot: str
    name: str
    kind: str
    parameters: int
    multiply_adds: int


def model_summary(model: StereoModel, height: int = 384, width: int = 1248) -> list[BlockCost]:
    """Parameters and multiply-adds of each block, for one pair of a size; nothing is computed.

    Interpolation, norms, activations and the softmax are not counted.

    Args:
        model: the network.
        height: of the images.
        width: of the images.

    >>> from stereokit import build_model
    >>> blocks = model_summary(build_model("coex"))
    >>> sum(block.parameters for block in blocks)
    2721993
    """
    # slow to import, and few need it
    from torch.utils.flop_counter import FlopCounterMode

    choices: dict[str, Any] = dict(model.config)
    # on the meta device shapes are worked out without data
    twin = copy.deepcopy(model).to("meta").eval()
    image = torch.empty(1, 3, height, width, device="meta")
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        twin(image, image)
    flops = {name: sum(ops.values()) for name, ops in counter.get_flop_counts().items()}
    return [
        BlockCost(
            slot=slot,
            name=choices[slot].get("name", "-"),
            kind=type(block).__name__,
            parameters=sum(p.numel() for p in block.parameters()),
            multiply_adds=flops.get(f"{type(model).__name__}.{slot}", 0) // 2,
        )
        for slot, block in model.named_children()
    ]
