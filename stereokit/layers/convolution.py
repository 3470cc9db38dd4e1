"""Convolution, norm and activation, once for every block."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal

from torch import Tensor, nn

from stereokit.errors import ConfigError

__all__ = [
    "Activation",
    "ConvNormAct",
    "Norm",
    "crop_to",
    "init_convolutions",
    "leaky_relu",
    "named_activation",
    "relu",
]

Activation = Callable[[], nn.Module]

Norm = Literal["batch", "instance", "affine_instance"]
"""Batch norm; or instance norm, without weights or with them, which has no running statistics."""

_CONV: dict[tuple[int, bool], type[nn.Module]] = {
    (2, False): nn.Conv2d,
    (3, False): nn.Conv3d,
    (2, True): nn.ConvTranspose2d,
    (3, True): nn.ConvTranspose3d,
}
_NORM: dict[tuple[int, str], Callable[[int], nn.Module]] = {
    (2, "batch"): nn.BatchNorm2d,
    (3, "batch"): nn.BatchNorm3d,
    (2, "instance"): nn.InstanceNorm2d,
    (3, "instance"): nn.InstanceNorm3d,
    (2, "affine_instance"): partial(nn.InstanceNorm2d, affine=True),
    (3, "affine_instance"): partial(nn.InstanceNorm3d, affine=True),
}


def leaky_relu(slope: float = 0.01) -> nn.Module:
    """LeakyReLU; a slope of 0.01 is the activation of CoEx."""
    return nn.LeakyReLU(slope, inplace=True)


def relu() -> nn.Module:
    """ReLU, the activation of PSMNet and GC-Net."""
    return nn.ReLU(inplace=True)


_ACTIVATIONS: dict[str, Activation] = {
    "relu": relu,
    "leaky_relu": leaky_relu,
    "leaky_relu_0.1": partial(leaky_relu, 0.1),
    "leaky_relu_0.2": partial(leaky_relu, 0.2),
    "relu6": partial(nn.ReLU6, inplace=True),
}


def named_activation(name: str) -> Activation:
    """What makes the activation of a name: "relu", "relu6", "leaky_relu" (slope 0.01), "leaky_relu_0.1" or "..._0.2".

    Raises:
        ConfigError: another name.

    >>> named_activation("leaky_relu_0.2")()
    LeakyReLU(negative_slope=0.2, inplace=True)
    """
    if name not in _ACTIVATIONS:
        raise ConfigError(f"unknown activation {name!r}; use one of {', '.join(map(repr, _ACTIVATIONS))}")
    return _ACTIVATIONS[name]


class ConvNormAct(nn.Sequential):
    """A convolution, a norm and an activation, initialised by `init_convolutions`.

    Args:
        in_channels: of the input.
        out_channels: of the output.
        kernel_size: odd for "same" padding at stride 1; one for all dimensions, or one for each.
        dims: 2 for maps (B, C, H, W), 3 for volumes (B, C, D, H, W).
        stride: halves every dimension where it is 2; or one for each dimension.
        dilation: padding grows with it, so that the size stays.
        transposed: upsample by `stride` instead: kernel 4 with stride 2, or kernel 3 with stride 2, doubles every
            dimension.
        groups: of channels that are convolved apart.
        bias: of the convolution; a batch norm makes it superfluous.
        norm: "batch", "instance", "affine_instance" or None for none.
        activation: called to make it; None leaves it out.
        order: "norm_act", or "act_norm" with the activation ahead of the norm.
        padding_mode: "zeros", or another one of PyTorch's convolutions.

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
        kernel_size: int | Sequence[int] = 3,
        *,
        dims: Literal[2, 3] = 2,
        stride: int | tuple[int, ...] = 1,
        dilation: int = 1,
        transposed: bool = False,
        groups: int = 1,
        bias: bool = False,
        norm: Norm | None = "batch",
        activation: Activation | None = leaky_relu,
        order: Literal["norm_act", "act_norm"] = "norm_act",
        padding_mode: str = "zeros",
    ) -> None:
        strides = (stride,) * dims if isinstance(stride, int) else stride
        sides = (kernel_size,) * dims if isinstance(kernel_size, int) else tuple(kernel_size)
        # what an odd kernel lacks of twice the size
        odd = tuple(side % 2 * (step - 1) for side, step in zip(sides, strides, strict=True))
        extra: dict[str, Any] = {"output_padding": odd} if transposed else {}
        conv = _CONV[dims, transposed](
            in_channels,
            out_channels,
            sides,
            stride=strides,
            padding=tuple(dilation * (side - 1) // 2 for side in sides),
            dilation=dilation,
            groups=groups,
            bias=bias,
            padding_mode=padding_mode,
            **extra,
        )
        init_convolutions(conv)
        after: list[nn.Module] = [] if norm is None else [_NORM[dims, norm](out_channels)]
        if activation is not None:
            after.append(activation())
        super().__init__(conv, *(after if order == "norm_act" else reversed(after)))


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
            fan_out = math.prod(layer.kernel_size) * layer.out_channels // layer.groups
            nn.init.normal_(layer.weight, std=math.sqrt(2 / fan_out))
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
