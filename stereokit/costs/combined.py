"""Several cost volumes concatenated."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from stereokit.errors import ConfigError
from stereokit.registry import COSTS

__all__ = ["CombinedVolume"]


@COSTS.register("combined")
class CombinedVolume(nn.Module):
    """Volumes of the same features, concatenated along their channels.

    Args:
        in_channels: of the features.
        planes: of disparity.
        parts: two or more costs, each a registered name, or a mapping of its name and arguments.

    Shape: two (B, in_channels, H, W) to (B, out_channels, planes, H, W), out_channels being the sum over the parts.

    Raises:
        ConfigError: fewer than two parts, or one that can't be built.

    Source: Guo et al., "Group-wise correlation stereo network", CVPR 2019, section 3.3.

    >>> parts = [{"name": "groupwise_correlation", "groups": 40}, {"name": "concatenation", "projection": [128, 12]}]
    >>> CombinedVolume(in_channels=320, planes=48, parts=parts).out_channels
    64
    """

    def __init__(self, *, in_channels: int, planes: int, parts: Sequence[str | Mapping[str, Any]]) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.planes = planes
        if isinstance(parts, str | Mapping) or len(parts) < 2:
            raise ConfigError(f"parts={parts!r}: a combined volume has two parts or more, in a list")
        built: list[Any] = []
        for part in parts:
            name, arguments = COSTS.named(part, "a part of a combined volume is the name of a cost")
            built.append(COSTS.build(name, arguments, {"in_channels": in_channels, "planes": planes}))
        self.parts = nn.ModuleList(built)
        self.out_channels = sum(part.out_channels for part in built)
        self.warps = all(getattr(part, "warps", False) for part in built)

    def forward(self, left: Tensor, right: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Left and right features to a cost volume."""
        given = () if candidates is None else (candidates,)
        return torch.cat([part(left, right, *given) for part in self.parts], dim=1)
