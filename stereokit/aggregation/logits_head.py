"""What turns a volume into logits."""

from torch import nn

from stereokit.layers import ConvNormAct, init_convolutions, relu

__all__ = ["logits_head"]


def logits_head(channels: int, *, bias: bool = False) -> nn.Sequential:
    """Two 3x3x3 convolutions: (B, channels, D, H, W) to (B, 1, D, H, W).

    Args:
        channels: of the volume.
        bias: of the first convolution, ahead of its norm.

    Source: Chang and Chen, "Pyramid Stereo Matching Network", CVPR 2018, table 1.

    >>> import torch
    >>> logits_head(4)(torch.rand(1, 4, 2, 3, 5)).shape
    torch.Size([1, 1, 2, 3, 5])
    """
    last = nn.Conv3d(channels, 1, 3, padding=1, bias=False)
    init_convolutions(last)
    return nn.Sequential(ConvNormAct(channels, channels, dims=3, bias=bias, activation=relu), last)
