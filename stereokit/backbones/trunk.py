"""The residual layers that PSMNet, GwcNet and those after them share."""

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor, nn

from stereokit.errors import ConfigError
from stereokit.layers import ConvNormAct, ResidualBlock, SeparableBlock, relu, residual_layer

__all__ = ["ResidualTrunk", "TrunkMaps"]


class TrunkMaps(NamedTuple):
    """What the parts of a `ResidualTrunk` give."""

    first: Tensor
    """(B, 32, H/2, W/2), after two convolutions; (B, 32, H, W) where these work at full size."""
    stem: Tensor
    """(B, 32, H/2, W/2), after the third one."""
    layer1: Tensor
    """(B, 32, H/2, W/2)."""
    layer2: Tensor
    """(B, 64, H/4, W/4)."""
    layer3: Tensor
    """(B, 128, H/4, W/4); of stride 8 with three halvings."""
    layer4: Tensor
    """(B, 128, H/4, W/4); likewise."""


class ResidualTrunk(nn.Module):
    """Three convolutions and 25 residual blocks, down to stride 4; the last three blocks are dilated.

    Args:
        full_size: the third convolution halves the size, in place of the first one.
        halvings: 3 to halve the size a third time, in place of the dilation.
        stem: other three layers in place of the convolutions, the first of which halves the size.
        block: of the layers.

    Raises:
        ConfigError: another number of halvings.

    Source: Chang and Chen, "Pyramid Stereo Matching Network", CVPR 2018, table 1, up to conv4_x.

    >>> import torch
    >>> ResidualTrunk().maps(torch.rand(1, 3, 32, 48)).layer4.shape
    torch.Size([1, 128, 8, 12])
    """

    def __init__(
        self,
        *,
        full_size: bool = False,
        halvings: int = 2,
        stem: nn.Sequential | None = None,
        block: Callable[..., ResidualBlock | SeparableBlock] = ResidualBlock,
    ) -> None:
        super().__init__()
        if halvings not in (2, 3):
            raise ConfigError(f"halvings={halvings} of the residual layers: use 2 for stride 4, or 3 for stride 8")
        self.full_size = full_size
        self.multiple = 2**halvings
        halves_at = 2 if full_size else 0
        self.stem = stem or nn.Sequential(
            *(ConvNormAct(32 if i else 3, 32, stride=2 if i == halves_at else 1, activation=relu) for i in range(3))
        )
        self.layer1 = residual_layer(32, 32, 3, block=block)
        self.layer2 = residual_layer(32, 64, 16, stride=2, block=block)
        self.layer3 = residual_layer(64, 128, 3, stride=halvings - 1, block=block)
        self.layer4 = residual_layer(128, 128, 3, dilation=4 - halvings, block=block)

    def maps(self, images: Tensor) -> TrunkMaps:
        """(B, 3, H, W), sides multiples of `multiple`, to the map of each part."""
        first = self.stem[1](self.stem[0](images))
        stem = self.stem[2](first)
        layer1 = self.layer1(stem)
        layer2 = self.layer2(layer1)
        layer3 = self.layer3(layer2)
        return TrunkMaps(first, stem, layer1, layer2, layer3, self.layer4(layer3))
