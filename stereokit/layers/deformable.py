"""Convolutions that sample where another convolution tells them to."""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.errors import ConfigError, InputError
from stereokit.layers.casting import at_least_float32
from stereokit.layers.convolution import init_convolutions

__all__ = ["DeformableConvolution", "deformable_convolution", "sampled_convolution"]


def deformable_convolution(
    x: Tensor, weight: Tensor, offsets: Tensor, mask: Tensor, *, stride: int = 1, dilation: int = 1
) -> Tensor:
    r"""A convolution whose kernel samples off the grid, each sample weighed by a mask.

    .. math:: y(p) = \sum_k w_k \cdot m_k(p)\, x(s p + r_k + o_k(p))

    Here r_k are the places of a dilated kernel around a pixel, o the offsets, m the mask and s the stride. Between
    pixels x is interpolated bilinearly; outside the map it is 0. Where a network is exported, `sampled_convolution`
    does it: the operator of torchvision is one that runtimes do not have.

    Args:
        x: (B, C, H, W). Numbers of half precision are computed with in float32.
        weight: w, (O, C, K, K) with odd K.
        offsets: o, (B, G * K * K * 2, h, w): for each of G groups of channels and each place of the kernel, row after
            row, pixels down and to the right.
        mask: m, (B, G * K * K, h, w).
        stride: s.
        dilation: pixels between the places of the kernel.

    Returns:
        (B, O, h, w), with h = ceil(H / s), w = ceil(W / s); in the type of x.

    Raises:
        InputError: shapes that do not fit.

    Source: Zhu et al., "Deformable ConvNets v2: more deformable, better results", CVPR 2019, equation 1.

    >>> x, weight = torch.rand(1, 4, 6, 8), torch.rand(2, 4, 3, 3)
    >>> still = deformable_convolution(x, weight, torch.zeros(1, 18, 6, 8), torch.ones(1, 9, 6, 8))
    >>> torch.allclose(still, F.conv2d(x, weight, padding=1), atol=1e-5)
    True
    """
    if torch.compiler.is_exporting():
        return sampled_convolution(x, weight, offsets, mask, stride=stride, dilation=dilation)
    _check(x, weight, offsets, mask, stride)
    # here: it takes a second to import, and few networks have such convolutions
    from torchvision.ops import deform_conv2d

    tensors = [at_least_float32(tensor) for tensor in (x, offsets, weight)]
    y: Tensor = deform_conv2d(
        *tensors,
        stride=stride,
        padding=dilation * (weight.shape[-1] // 2),
        dilation=dilation,
        mask=at_least_float32(mask),
    )
    return y.to(x.dtype)


def sampled_convolution(
    x: Tensor, weight: Tensor, offsets: Tensor, mask: Tensor, *, stride: int = 1, dilation: int = 1
) -> Tensor:
    """`deformable_convolution` as bilinear samples times a matrix, which every runtime has.

    Args:
        x: (B, C, H, W).
        weight: (O, C, K, K).
        offsets: (B, G * K * K * 2, h, w).
        mask: (B, G * K * K, h, w).
        stride: of the convolution.
        dilation: of its kernel.

    >>> x, weight = torch.rand(1, 4, 6, 8), torch.rand(2, 4, 3, 3)
    >>> offsets, mask = torch.randn(1, 18, 3, 4), torch.rand(1, 9, 3, 4)
    >>> sampled = sampled_convolution(x, weight, offsets, mask, stride=2)
    >>> torch.allclose(sampled, deformable_convolution(x, weight, offsets, mask, stride=2), atol=1e-4)
    True
    """
    height, width = x.shape[-2:]
    rows, columns = offsets.shape[-2:]
    kernel = weight.shape[-1]
    places = kernel * kernel
    groups = mask.shape[1] // places
    kind = at_least_float32(offsets).dtype
    offsets = offsets.to(kind).reshape(-1, places, 2, rows, columns)

    reach = (torch.arange(kernel, device=x.device, dtype=kind) - kernel // 2) * dilation
    down = torch.arange(rows, device=x.device, dtype=kind).unsqueeze(1) * stride
    right = torch.arange(columns, device=x.device, dtype=kind) * stride
    y = offsets[:, :, 0] + reach.repeat_interleave(kernel).reshape(-1, 1, 1) + down
    x_ = offsets[:, :, 1] + reach.repeat(kernel).reshape(-1, 1, 1) + right
    # centres of the pixels from -1 to 1, as `grid_sample` wants them with corners that are not aligned
    grid = torch.stack(((2 * x_ + 1) / width - 1, (2 * y + 1) / height - 1), dim=-1).flatten(1, 2)
    by_group = at_least_float32(x).reshape(-1, x.shape[1] // groups, height, width)
    samples = F.grid_sample(by_group, grid.to(by_group.dtype), padding_mode="zeros", align_corners=False)
    samples = samples.reshape(-1, x.shape[1] // groups, places, rows * columns)
    samples = samples * mask.reshape(-1, 1, places, rows * columns)
    samples = samples.reshape(-1, x.shape[1] * places, rows * columns)
    return (weight.flatten(1).to(samples.dtype) @ samples).reshape(-1, len(weight), rows, columns).to(x.dtype)


def _check(x: Tensor, weight: Tensor, offsets: Tensor, mask: Tensor, stride: int) -> None:
    places = math.prod(weight.shape[2:])
    groups = mask.shape[1] // places
    size = tuple((side + stride - 1) // stride for side in x.shape[-2:])
    fits = (
        weight.shape[2] == weight.shape[3]
        and weight.shape[2] % 2 == 1
        and weight.shape[1] == x.shape[1]
        and groups > 0
        and x.shape[1] % groups == 0
        and mask.shape == (len(x), groups * places, *size)
        and offsets.shape == (len(x), 2 * groups * places, *size)
    )
    if not fits:
        raise InputError(
            "a deformable convolution wants maps (B, C, H, W), weights (O, C, K, K) with odd K, offsets "
            "(B, 2 G K K, h, w) and a mask (B, G K K, h, w) of the size of its output; got "
            f"{tuple(x.shape)}, {tuple(weight.shape)}, {tuple(offsets.shape)} and {tuple(mask.shape)}"
        )


class DeformableConvolution(nn.Module):
    """`deformable_convolution` of 3x3 places, with a convolution of the same maps that gives offsets and mask.

    That one starts from 0: there are no offsets and the mask is 1, so that both are an ordinary convolution at first.
    The mask lies between 0 and 2. The convolution that gives them has `groups` groups itself, as in AANet.

    Args:
        in_channels: of the maps; a multiple of the groups.
        out_channels: of what comes out.
        stride: 2 halves the size.
        dilation: pixels between the places of the kernel.
        groups: of channels, each with offsets and a mask of its own.

    Shape: (B, in_channels, H, W) to (B, out_channels, H / stride, W / stride). It has no bias.

    Raises:
        ConfigError: groups that do not divide the channels.

    Source: Xu and Zhang, "AANet: adaptive aggregation network for efficient stereo matching", CVPR 2020, section 3.1;
    Zhu et al., CVPR 2019.

    >>> DeformableConvolution(8, 16, stride=2)(torch.rand(1, 8, 7, 12)).shape
    torch.Size([1, 16, 4, 6])
    """

    def __init__(
        self, in_channels: int, out_channels: int, *, stride: int = 1, dilation: int = 2, groups: int = 2
    ) -> None:
        super().__init__()
        if in_channels % groups:
            raise ConfigError(f"groups={groups} do not divide the {in_channels} channels of a deformable convolution")
        self.stride = stride
        self.dilation = dilation
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, 3, 3))
        ordinary = nn.Conv2d(in_channels, out_channels, 3, bias=False)
        init_convolutions(ordinary)
        self.weight.data.copy_(ordinary.weight.data)
        self.places = nn.Conv2d(
            in_channels, 27 * groups, 3, stride=stride, padding=dilation, dilation=dilation, groups=groups
        )
        nn.init.zeros_(self.places.weight)
        assert self.places.bias is not None
        nn.init.zeros_(self.places.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Maps to maps."""
        offsets, mask = self.places(x).split((self.places.out_channels // 3 * 2, self.places.out_channels // 3), dim=1)
        mask = 2 * at_least_float32(mask).sigmoid()
        return deformable_convolution(x, self.weight, offsets, mask, stride=self.stride, dilation=self.dilation)

    def extra_repr(self) -> str:
        """Channels, stride and dilation, for printing."""
        out_channels, in_channels = self.weight.shape[:2]
        return f"{in_channels}, {out_channels}, stride={self.stride}, dilation={self.dilation}"
