"""The block of PDS-Net: activation ahead of the norm."""

from functools import partial

from torch import Tensor, nn

from stereokit.layers.convolution import ConvNormAct, leaky_relu

__all__ = ["ActNormResidual", "conv_act_norm"]

conv_act_norm = partial(
    ConvNormAct, bias=True, norm="affine_instance", activation=partial(leaky_relu, 0.1), order="act_norm"
)
"""A convolution with bias, LeakyReLU of slope 0.1, and an instance norm with weights."""


class ActNormResidual(nn.Module):
    """Two 3x3 convolutions, each followed by activation and norm, and a skip.

    Args:
        channels: of input and output.

    Source: Tulyakov et al., "Practical Deep Stereo (PDS): toward applications-friendly deep stereo matching",
    NeurIPS 2018.

    >>> import torch
    >>> ActNormResidual(4)(torch.rand(1, 4, 5, 6)).shape
    torch.Size([1, 4, 5, 6])
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = conv_act_norm(channels, channels), conv_act_norm(channels, channels)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, H, W) to the same."""
        return x + self.conv2(self.conv1(x))
