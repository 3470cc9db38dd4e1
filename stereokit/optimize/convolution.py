"""A convolution with its batch norm folded in and its activation applied on the way out."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.optimize.training import SmallConv3d, SmallConvTranspose3d, StridedDepthwise
from stereokit.runtime.processor import compiles_transposed, onednn_types

__all__ = ["Convolution", "FusedConvolution", "fold_batch_norm", "fusable_activation", "is_plain_convolution"]

Convolution: TypeAlias = nn.Conv2d | nn.Conv3d | nn.ConvTranspose2d | nn.ConvTranspose3d

PLAIN = (nn.Conv2d, nn.Conv3d, nn.ConvTranspose2d, nn.ConvTranspose3d)
# which compute the same
OF_TRAINING = (StridedDepthwise, SmallConv3d, SmallConvTranspose3d)

# fewer output channels than this leave most of a vector register empty
NARROW = 10


FUNCTIONS: dict[str, Callable[..., Tensor]] = {
    "none": lambda x: x,
    "relu": F.relu_,
    "leaky_relu": F.leaky_relu_,
    "hardtanh": F.hardtanh_,
    "hardswish": F.hardswish,
    "swish": F.silu,
}


class Activation(NamedTuple):
    """An activation by the name and the numbers that oneDNN knows it by."""

    name: str
    numbers: tuple[float, ...] = ()

    def apply(self, x: Tensor) -> Tensor:
        """The activation of x, which may be overwritten."""
        return FUNCTIONS[self.name](x, *self.numbers)


NO_ACTIVATION = Activation("none")


def fusable_activation(module: nn.Module) -> Activation | None:
    """The activation of a module, if a convolution can apply it to its own output; None otherwise.

    >>> fusable_activation(nn.LeakyReLU(0.2)).numbers, fusable_activation(nn.Softmax(1))
    ((0.2,), None)
    """
    # by exact type: subclasses may compute something else
    kind = type(module)
    if isinstance(module, nn.LeakyReLU) and kind is nn.LeakyReLU:
        return Activation("leaky_relu", (float(module.negative_slope),))
    if isinstance(module, nn.Hardtanh) and kind in (nn.Hardtanh, nn.ReLU6):
        return Activation("hardtanh", (float(module.min_val), float(module.max_val)))
    names: dict[type, str] = {nn.Identity: "none", nn.ReLU: "relu", nn.Hardswish: "hardswish", nn.SiLU: "swish"}
    return Activation(names[kind]) if kind in names else None


def is_plain_convolution(module: nn.Module) -> bool:
    """Whether a module is one of PyTorch's convolutions as it comes: no subclass, hooks or other padding than zeros."""
    return (
        isinstance(module, PLAIN)
        and type(module) in PLAIN + OF_TRAINING
        and module.padding_mode == "zeros"
        and not isinstance(module.padding, str)
        # replaced on the instance
        and "forward" not in vars(module)
    )


def fold_batch_norm(conv: Convolution, norm: nn.BatchNorm2d | nn.BatchNorm3d) -> tuple[Tensor, Tensor]:
    r"""Weight and bias of the one convolution that does what a convolution and the batch norm after it do in eval mode.

    .. math:: w' = \frac{\gamma}{\sqrt{\sigma^2 + \epsilon}} w, \qquad
        b' = \frac{\gamma}{\sqrt{\sigma^2 + \epsilon}} (b - \mu) + \beta

    Args:
        conv: any convolution, transposed or grouped too.
        norm: with running statistics.

    Returns:
        Detached copies, in the type of the convolution.
    """
    assert norm.running_mean is not None
    assert norm.running_var is not None
    weight = conv.weight.detach().double()
    scale = (norm.running_var.double() + norm.eps).rsqrt()
    shift = -norm.running_mean.double() * scale
    if norm.affine:
        gain = norm.weight.detach().double()
        scale, shift = scale * gain, shift * gain + norm.bias.detach().double()
    if conv.bias is not None:
        shift = shift + conv.bias.detach().double() * scale
    if conv.transposed:
        # (in, out / groups, ...): the output channels of one group after the other
        by_group = weight.reshape(conv.groups, -1, *weight.shape[1:])
        factors = scale.reshape(conv.groups, 1, -1, *[1] * len(conv.kernel_size))
        weight = (by_group * factors).flatten(0, 1)
    else:
        weight = weight * scale.reshape(-1, *[1] * (weight.dim() - 1))
    return weight.to(conv.weight.dtype), shift.to(conv.weight.dtype)


class FusedConvolution(nn.Module):
    """A convolution, the batch norm after it and the activation after that, as one layer for inference.

    On the CPU it calls oneDNN in channels-last layout. PyTorch's own choice for a 3D convolution of one small volume in
    float32 is a kernel up to ten times slower. Two kinds of layers that few output channels make slow there as well are
    written as others: see `_doubled` and `_by_slices`. Elsewhere, and in an exported program, the same
    sums are ATen's.

    Args:
        conv: `is_plain_convolution`. Its weights are copied.
        norm: the batch norm after it, None for none.
        activation: what follows, None for nothing.

    Shape: that of the convolution.

    >>> conv, norm = nn.Conv2d(3, 8, 3, padding=1), nn.BatchNorm2d(8).eval()
    >>> fused = FusedConvolution(conv, norm, fusable_activation(nn.ReLU()))
    >>> x = torch.rand(1, 3, 5, 6)
    >>> torch.allclose(fused(x), norm(conv(x)).relu(), atol=1e-5)
    True
    """

    weight: Tensor
    bias: Tensor | None

    def __init__(
        self,
        conv: Convolution,
        norm: nn.BatchNorm2d | nn.BatchNorm3d | None = None,
        activation: Activation | None = None,
    ) -> None:
        super().__init__()
        self.in_channels, self.out_channels = conv.in_channels, conv.out_channels
        self.kernel_size, self.groups, self.transposed = conv.kernel_size, conv.groups, conv.transposed
        self.stride, self.padding = sizes(conv.stride), sizes(conv.padding)
        self.dilation, self.output_padding = sizes(conv.dilation), sizes(conv.output_padding)
        self.activation = activation or NO_ACTIVATION
        # looked up here, so that the compiler sees constants
        self.onednn_types = onednn_types()
        self.compiles_transposed = compiles_transposed()
        if norm is None:
            weight = conv.weight.detach()
            bias = None if conv.bias is None else conv.bias.detach().clone()
        else:
            weight, bias = fold_batch_norm(conv, norm)
        on_cpu = weight.device.type == "cpu"
        self.subpixel = on_cpu and is_narrow_doubling(conv)
        self.by_slices = on_cpu and is_narrow_3d(conv)
        if self.subpixel:
            weight = subpixel_weight(weight)
            bias = None if bias is None else bias.repeat(2 ** len(conv.kernel_size))
        elif self.by_slices:
            # (1, C, kd, kh, kw) to (kd, C, kh, kw)
            weight = weight.squeeze(0).transpose(0, 1)
        self.memory_format = torch.channels_last if weight.dim() == 4 else torch.channels_last_3d
        self.register_buffer("weight", weight.clone(memory_format=self.memory_format))
        self.register_buffer("bias", bias)

    def forward(self, x: Tensor) -> Tensor:
        """(B, in_channels, ..., H, W) to (B, out_channels, ..., H', W')."""
        x = x.to(self.weight.dtype)
        if self.subpixel:
            return self._doubled(x)
        if self.by_slices:
            return self._by_slices(x)
        return self._transposed(x) if self.transposed else self._convolved(x)

    def _convolved(self, x: Tensor) -> Tensor:
        return self._convolve(x, self.bias, self.padding, self.stride, self.dilation, self.groups, self.activation)

    def _transposed(self, x: Tensor) -> Tensor:
        x = x.contiguous(memory_format=self.memory_format)
        if not calls_onednn(x, self.onednn_types) or (torch.compiler.is_compiling() and not self.compiles_transposed):
            conv = F.conv_transpose2d if x.dim() == 4 else F.conv_transpose3d
            y = conv(
                x, self.weight, self.bias, self.stride, self.padding, self.output_padding, self.groups, self.dilation
            )
            return self.activation.apply(y)
        settings = (self.padding, self.output_padding, self.stride, self.dilation, self.groups)
        return torch.ops.mkldnn._convolution_transpose_pointwise(
            x, self.weight, self.bias, *settings, self.activation.name, list(self.activation.numbers), ""
        )

    def _doubled(self, x: Tensor) -> Tensor:
        """A transposed convolution, as a convolution to one channel per parity of the output's coordinates."""
        size, ones = x.shape[2:], [1] * (x.dim() - 2)
        y = self._convolve(x, self.bias, ones, ones, ones, 1, self.activation)
        for dim, length in enumerate(size, start=2):
            even, odd = y.chunk(2, dim=1)
            halves = (even.narrow(dim, 0, length), odd.narrow(dim, 1, length))
            y = torch.stack(halves, dim=dim + 1).flatten(dim, dim + 1)
        return y

    def _by_slices(self, x: Tensor) -> Tensor:
        """A 3D convolution to one channel, as a 2D one to a channel per depth of the kernel, and the sum of those."""
        batch, depth = x.shape[0], x.shape[2]
        slices = x.transpose(1, 2).flatten(0, 1)
        y = self._convolve(slices, None, self.padding[1:], self.stride[1:], self.dilation[1:], 1, NO_ACTIVATION)
        y = F.pad(y.reshape(batch, depth, *y.shape[1:]), (0, 0, 0, 0, 0, 0, self.padding[0], self.padding[0]))
        levels = depth + 2 * self.padding[0] - self.kernel_size[0] + 1
        total = reduce(torch.add, (y[:, k : k + levels, k] for k in range(self.kernel_size[0]))).unsqueeze(1)
        return self.activation.apply(total if self.bias is None else total + self.bias)

    def _convolve(
        self,
        x: Tensor,
        bias: Tensor | None,
        padding: list[int],
        stride: list[int],
        dilation: list[int],
        groups: int,
        activation: Activation,
    ) -> Tensor:
        """Convolution and activation, by oneDNN or by ATen."""
        x, weight = x.contiguous(memory_format=self.memory_format), self.weight
        if not calls_onednn(x, self.onednn_types):
            conv = F.conv2d if x.dim() == 4 else F.conv3d
            return activation.apply(conv(x, weight, bias, stride, padding, dilation, groups))
        if x.shape[1] == 1 and torch.compiler.is_compiling():
            # one channel lies alike in both layouts: compiling for any size, Inductor expects a result in the other
            second_channel = (0, 0) * (x.dim() - 2) + (0, 1)
            x, weight = F.pad(x, second_channel), F.pad(weight, second_channel)
        return torch.ops.mkldnn._convolution_pointwise(
            x, weight, bias, padding, stride, dilation, groups, activation.name, list(activation.numbers), ""
        )

    def extra_repr(self) -> str:
        """Sizes and activation, for printing."""
        kind = "transposed, " if self.transposed else ""
        return (
            f"{self.in_channels}, {self.out_channels}, {kind}kernel_size={self.kernel_size}, "
            f"stride={tuple(self.stride)}, activation={self.activation.name}"
        )


def sizes(values: Sequence[Any]) -> list[int]:
    """The sizes of a convolution, one per dimension."""
    return [int(value) for value in values]


def calls_onednn(x: Tensor, types: frozenset[torch.dtype]) -> bool:
    """Whether oneDNN is called directly: on the CPU, without a gradient, and not in a program made for elsewhere."""
    return (
        x.device.type == "cpu"
        and x.dtype in types
        and not (torch.is_grad_enabled() and x.requires_grad)
        and not torch.compiler.is_exporting()
    )


def is_narrow_doubling(conv: Convolution) -> bool:
    """Whether a transposed convolution doubles the size and gives few channels."""
    sizes = {(4, 2, 1, 0), (3, 2, 1, 1)}
    return (
        conv.transposed
        and conv.groups == 1
        and conv.out_channels < NARROW
        and len(found := set(zip(conv.kernel_size, conv.stride, conv.padding, conv.output_padding, strict=True))) == 1
        and found <= sizes
        and set(conv.dilation) == {1}
    )


def is_narrow_3d(conv: Convolution) -> bool:
    """Whether a 3D convolution gives one channel and keeps the depth."""
    return (
        isinstance(conv, nn.Conv3d)
        and conv.out_channels == 1
        and conv.groups == 1
        and conv.stride[0] == conv.dilation[0] == 1
        and conv.kernel_size[0] > 1
    )


def subpixel_weight(weight: Tensor) -> Tensor:
    r"""The weight of the convolution that gives all parities of a transposed convolution with stride 2, padding 1.

    In one dimension :math:`y(2i + p) = \sum_t w(3 - p - 2t)\, x(i + p - 1 + t)` for the parities p and the taps t, both
    0 or 1: two sums over two neighbours, and the one for p = 1 is that of the next i.

    Args:
        weight: (C, K, 4, 4) or (C, K, 3, 3), and likewise in 3D.

    Returns:
        (4 K, C, 2, 2), or (8 K, C, 2, 2, 2); the parities come before K.

    Source: Shi et al., "Is the deconvolution layer the same as a convolutional layer?", 2016.
    """
    dims = weight.dim() - 2
    weight = F.pad(weight, (0, 4 - weight.shape[-1]) * dims)
    parity, tap = torch.meshgrid(torch.arange(2), torch.arange(2), indexing="ij")
    for dim in range(dims):
        # each (4,) becomes (parity, tap)
        weight = weight.movedim(2 + 2 * dim, -1)[..., 3 - parity - 2 * tap].movedim(
            (-2, -1), (2 + 2 * dim, 3 + 2 * dim)
        )
    parities, taps = range(2, 2 + 2 * dims, 2), range(3, 3 + 2 * dims, 2)
    return weight.permute(*parities, 1, 0, *taps).flatten(0, dims)
