"""One step of a decoder with skips."""

from functools import partial

import torch
from torch import Tensor, nn

from stereokit.layers.convolution import Activation, ConvNormAct, Norm, crop_to, leaky_relu

__all__ = ["UpStep"]


class UpStep(nn.Module):
    """Doubles the size, concatenates the finer skip, and convolves.

    Args:
        in_channels: of the coarse map.
        skip_channels: of the skip, and of the coarse map once it is doubled.
        out_channels: of the output.
        activation: of both convolutions.
        skip_first: concatenate the skip ahead of the doubled map.
        norm: of both convolutions.
        kernel_size: of the transposed convolution, 3 or 4.

    >>> UpStep(8, 4, 6)(torch.rand(1, 8, 3, 5), torch.rand(1, 4, 6, 10)).shape
    torch.Size([1, 6, 6, 10])
    """

    def __init__(
        self,
        in_channels: int,
        skip_channels: int,
        out_channels: int,
        *,
        activation: Activation = leaky_relu,
        skip_first: bool = False,
        norm: Norm = "batch",
        kernel_size: int = 4,
    ) -> None:
        super().__init__()
        self.out_channels = out_channels
        self.skip_first = skip_first
        conv = partial(ConvNormAct, norm=norm, activation=activation)
        self.up = conv(in_channels, skip_channels, kernel_size, stride=2, transposed=True)
        self.merge = conv(2 * skip_channels, out_channels)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """Coarse (B, C, h, w) and skip (B, S, 2h, 2w) to (B, out_channels, 2h, 2w)."""
        doubled = crop_to(self.up(x), skip)
        return self.merge(torch.cat((skip, doubled) if self.skip_first else (doubled, skip), dim=1))
