"""Convolution, norm and activation, once for every block."""

import math
from collections.abc import Callable
from typing import Literal

from torch import Tensor, nn

__all__ = ["ConvNormAct", "at_least_float32", "crop_to", "init_convolutions"]

Activation = Callable[[], nn.Module]

_CONV: dict[tuple[int, bool], type[nn.Module]] = {
    (2, False): nn.Conv2d,
    (3, False): nn.Conv3d,
    (2, True): nn.ConvTranspose2d,
    (3, True): nn.ConvTranspose3d,
}
_NORM = {2: nn.BatchNorm2d, 3: nn.BatchNorm3d}


def leaky_relu() -> nn.Module:
    """LeakyReLU(0.01), the activation of CoEx."""
    return nn.LeakyReLU(0.01, inplace=True)


def relu() -> nn.Module:
    """ReLU, the activation of PSMNet and GC-Net."""
    return nn.ReLU(inplace=True)


class ConvNormAct(nn.Sequential):
    """A convolution without bias, batch norm, and an activation, initialised by `init_convolutions`.

    Args:
        in_channels: of the input.
        out_channels: of the output.
        kernel_size: odd for "same" padding at stride 1.
        dims: 2 for maps (B, C, H, W), 3 for volumes (B, C, D, H, W).
        stride: halves every dimension where it is 2.
        dilation: padding grows with it, so that the size stays.
        transposed: upsample by `stride` instead: kernel 4 with stride 2, or kernel 3 with stride 2, doubles every
            dimension.
        activation: called to make it; None leaves it out.

    >>> import torch
    >>> ConvNormAct(3, 8, 3, stride=2)(torch.rand(1, 3, 6, 8)).shape
    torch.Size([1, 8, 3, 4])
    >>> ConvNormAct(3, 8, 4, dims=3, stride=2, transposed=True)(torch.rand(1, 3, 2, 3, 4)).shape
    torch.Size([1, 8, 4, 6, 8])
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        kernel_size: int = 3,
        *,
        dims: Literal[2, 3] = 2,
        stride: int = 1,
        dilation: int = 1,
        transposed: bool = False,
        activation: Activation | None = leaky_relu,
    ) -> None:
        padding = dilation * (kernel_size - 1) // 2
        extra = {"output_padding": kernel_size % 2} if transposed else {}
        conv = _CONV[dims, transposed](
            in_channels,
            out_channels,
            kernel_size,
            stride=stride,
            padding=padding,
            dilation=dilation,
            bias=False,
            **extra,
        )
        init_convolutions(conv)
        layers: list[nn.Module] = [conv, _NORM[dims](out_channels)]
        if activation is not None:
            layers.append(activation())
        super().__init__(*layers)


def at_least_float32(x: Tensor) -> Tensor:
    """Half precision to single; float64 stays. For norms, distributions and disparities.

    Sums of squares overflow in float16, and bfloat16 has steps of half a pixel at 100.
    """
    return x.float() if x.dtype.itemsize == 2 else x


def crop_to(x: Tensor, like: Tensor) -> Tensor:
    """Cuts the trailing (depth,) height and width of an upsampled map to those of its finer neighbour.

    Halving an odd size n gives (n + 1) / 2, and doubling that gives n + 1: one row too many.
    """
    for dim in range(2, like.dim()):
        x = x.narrow(dim, 0, like.shape[dim])
    return x


def init_convolutions(module: nn.Module) -> None:
    """Convolution weights from N(0, 2 / (k^n * out_channels)), biases 0: the initialisation of CoEx and PSMNet."""
    for layer in module.modules():
        if isinstance(layer, nn.Conv2d | nn.Conv3d | nn.ConvTranspose2d | nn.ConvTranspose3d):
            fan_out = math.prod(layer.kernel_size) * layer.out_channels
            nn.init.normal_(layer.weight, std=math.sqrt(2 / fan_out))
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
