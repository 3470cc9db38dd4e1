"""One step between the scales of an hourglass that has skips on the way down too."""

from typing import Literal

import torch
from torch import Tensor, nn

from stereokit.layers.convolution import Activation, ConvNormAct, crop_to, relu

__all__ = ["ResampleStep"]


class ResampleStep(nn.Module):
    """Halves or doubles the size, concatenates the skip of that size, and convolves.

    Volumes are doubled by a kernel of 3 x 4 x 4, so that 2n - 1 planes come of n where the skip has as many.

    Args:
        in_channels: of the input.
        out_channels: of the skip, and of the output.
        dims: 2 for maps, 3 for volumes.
        up: double the size, in place of halving it.
        activation: of the last convolution; None for none.

    Source: Zhang et al., "GA-Net: guided aggregation net for end-to-end stereo matching", CVPR 2019, appendix A.

    >>> ResampleStep(8, 4, dims=3, up=True)(torch.rand(1, 8, 3, 4, 5), torch.rand(1, 4, 5, 8, 10)).shape
    torch.Size([1, 4, 5, 8, 10])
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        dims: Literal[2, 3] = 2,
        up: bool,
        activation: Activation | None = relu,
    ) -> None:
        super().__init__()
        kernel: int | tuple[int, ...] = ((3, 4, 4) if dims == 3 else 4) if up else 3
        self.resample = ConvNormAct(
            in_channels, out_channels, kernel, dims=dims, stride=2, transposed=up, activation=relu
        )
        self.merge = ConvNormAct(2 * out_channels, out_channels, dims=dims, activation=activation)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """Input and a skip of half or twice its size to the skip's shape."""
        return self.merge(torch.cat((crop_to(self.resample(x), skip), skip), dim=1))
