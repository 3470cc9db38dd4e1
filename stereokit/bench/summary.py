"""What a network costs: parameters and multiply-adds, block by block."""

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from stereokit.config import NetworkConfig
from stereokit.layers import DeformableConvolution
from stereokit.network import StereoNetwork

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


def model_summary(model: StereoNetwork, height: int = 384, width: int = 1248) -> list[BlockCost]:
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

    config = model._config or {}
    # on the meta device shapes are worked out without data
    twin = copy.deepcopy(model).to("meta").eval()
    image = torch.empty(1, 3, height, width, device="meta")
    with FlopCounterMode(display=False, custom_mapping=_of_torchvision(model)) as counter, torch.no_grad():
        twin(image, image)
    flops = {name: sum(ops.values()) for name, ops in counter.get_flop_counts().items()}
    return [
        BlockCost(
            slot=slot,
            name=name,
            kind=type(block).__name__,
            parameters=sum(p.numel() for p in block.parameters()),
            multiply_adds=_of_block(flops, f"{type(model).__name__}.{slot}") // 2,
        )
        for slot, name, block in _blocks(model, config)
    ]


def _of_block(flops: Mapping[str, int], path: str) -> int:
    """Of a block, or of its parts where it is used by another method than its forward."""
    parts = (count for name, count in flops.items() if name.rpartition(".")[0] == path)
    return flops[path] if path in flops else sum(parts)


def _of_torchvision(model: StereoNetwork) -> dict[Any, Any]:
    """How operations are counted that PyTorch does not know."""
    if not any(isinstance(module, DeformableConvolution) for module in model.modules()):
        return {}
    import torchvision.ops  # noqa: F401, which registers it

    def deformable(_x: Any, weight: Sequence[int], *_others: Any, out_shape: Sequence[int], **_named: Any) -> int:
        return 2 * math.prod(out_shape) * math.prod(weight[1:])

    return {torch.ops.torchvision.deform_conv2d: deformable}


def _blocks(model: StereoNetwork, config: NetworkConfig) -> Iterator[tuple[str, str, nn.Module]]:
    """The blocks of a network: where each stands, its registered name, and itself."""
    for slot, block in model.named_children():
        if not isinstance(block, nn.ModuleList):
            yield slot, _name(config.get(slot)), block
            continue
        # the coarser costs are the cost once more
        listed = config.get(slot) or [config.get("cost") if slot == "coarser_costs" else None] * len(block)
        for number, (part, choice) in enumerate(zip(block, listed, strict=True)):
            yield f"{slot}.{number}", _name(choice), part


def _name(choice: object) -> str:
    return str(choice.get("name", "-")) if isinstance(choice, Mapping) else "-"
