"""A learned projection of the matching features before they are compared."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from stereokit.layers import ConvNormAct, init_convolutions

__all__ = ["Projection"]


class Projection(nn.Module):
    """Convolution 3x3 with norm and LeakyReLU, then 1x1 with bias, on both views alike; or nothing.

    Args:
        in_channels: of the features.
        widths: channels after the 3x3 and after the 1x1 convolution; None leaves the features as they are.

    Shape: two (B, in_channels, H, W) to two (B, out_channels, H, W).

    Source: CoEx, section "Matching cost computation".

    >>> Projection(96, (48, 24)).out_channels
    24
    """

    def __init__(self, in_channels: int, widths: Sequence[int] | None) -> None:
        super().__init__()
        self.layers = nn.Sequential()
        self.out_channels = in_channels
        if widths is not None:
            hidden, self.out_channels = widths
            self.layers.append(ConvNormAct(in_channels, hidden))
            self.layers.append(nn.Conv2d(hidden, self.out_channels, 1))
        init_convolutions(self.layers)

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        """Left and right features to projected ones."""
        if not self.layers:
            return left, right
        left, right = self.layers(torch.cat((left, right))).chunk(2)
        return left, right
