"""Superpixel upsampling: each pixel is a learned mean of the 3x3 coarse cells around it."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Literal, get_args

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from stereokit.contracts import Guides
from stereokit.errors import ConfigError, InputError
from stereokit.layers import ConvNormAct, Norm, at_least_float32, crop_to, init_convolutions, named_activation
from stereokit.registry import UPSAMPLERS

__all__ = ["SuperpixelUpsampler", "Superpixels", "superpixel_upsample"]

Padding = Literal["replicate", "zeros"]


def superpixel_upsample(disparity: Tensor, weights: Tensor, *, padding: Padding = "replicate") -> Tensor:
    r"""Weighted mean of the 3x3 coarse values around the cell that each fine pixel lies in.

    .. math:: \hat d(y, x) = \sum_{k=1}^{9} w_k(y, x)\, d_k(\lfloor y / s \rfloor, \lfloor x / s \rfloor)

    Args:
        disparity: d, (B, h, w). Values are not scaled.
        weights: w, (B, 9, h * s, w * s), summing to 1; neighbours in row-major order from the top left.
        padding: what lies outside the coarse map: its "replicate"d edge, or "zeros" as in the published CoEx, which
            pull the border towards 0.

    Returns:
        (B, h * s, w * s).

    Raises:
        InputError: the shapes do not fit, or the padding is unknown.

    Source: CoEx, section "Top-k disparity regression"; Yang et al., "Superpixel segmentation with fully convolutional
    networks", CVPR 2020.

    >>> centre = torch.zeros(1, 9, 4, 4)
    >>> centre[:, 4] = 1
    >>> superpixel_upsample(torch.tensor([[[1.0, 2.0], [3.0, 4.0]]]), centre)[0, 0]
    tensor([1., 1., 2., 2.])
    """
    if padding not in get_args(Padding):
        raise InputError(f"padding={padding!r} is unknown; use 'replicate' or 'zeros'")
    height, width = disparity.shape[-2:]
    scale = weights.shape[-2] // height
    if disparity.dim() != 3 or tuple(weights.shape[1:]) != (9, scale * height, scale * width) or scale < 1:
        raise InputError(
            f"superpixel weights are (B, 9, h * s, w * s) for a disparity (B, h, w); got {tuple(weights.shape)} for "
            f"{tuple(disparity.shape)}"
        )
    mode = "constant" if padding == "zeros" else "replicate"
    padded = F.pad(disparity.unsqueeze(1), (1, 1, 1, 1), mode=mode).squeeze(1)
    # cells as (h, s, w, s): each coarse value broadcasts over its own cell, and no map is enlarged nine times
    cells = rearrange(weights, "b k (h sy) (w sx) -> b k h sy w sx", h=height, w=width)
    trained = torch.is_grad_enabled() and (padded.requires_grad or cells.requires_grad)
    total = _WeighedNeighbors.apply(padded, cells) if trained else weighed_neighbors(padded, cells)
    return rearrange(total, "b h sy w sx -> b (h sy) (w sx)")


def weighed_neighbors(padded: Tensor, cells: Tensor) -> Tensor:
    """Sum over the 3x3 neighbours of each coarse cell: (B, h + 2, w + 2) and (B, 9, h, s, w, s) to (B, h, s, w, s)."""
    total = torch.zeros_like(cells[:, 0])
    for k in range(9):
        total = torch.addcmul(total, cells[:, k], _neighbor(padded, k))
    return total


def _neighbor(padded: Tensor, k: int) -> Tensor:
    """The k-th neighbour of each cell, a view (B, h, 1, w, 1)."""
    y, x = divmod(k, 3)
    height, width = padded.shape[1] - 2, padded.shape[2] - 2
    return padded[:, y : y + height, x : x + width][:, :, None, :, None]


class _WeighedNeighbors(torch.autograd.Function):
    """`weighed_neighbors`, with a backward pass that fills one gradient of the weights in place.

    Autograd's own makes the gradient of each of the nine maps and then stacks them.
    """

    @staticmethod
    def forward(ctx: Any, padded: Tensor, cells: Tensor) -> Tensor:
        ctx.save_for_backward(padded, cells)
        return weighed_neighbors(padded, cells)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:
        padded, cells = ctx.saved_tensors
        of_padded = torch.zeros_like(padded) if ctx.needs_input_grad[0] else None
        of_cells = torch.empty_like(cells) if ctx.needs_input_grad[1] else None
        for k in range(9):
            if of_cells is not None:
                of_cells[:, k] = grad * _neighbor(padded, k)
            if of_padded is not None:
                # a view, so this adds into the gradient
                _neighbor(of_padded, k).add_((grad * cells[:, k]).sum((2, 4), keepdim=True))
        return of_padded, of_cells


class Superpixels(nn.Module):
    """What superpixel upsamplers share; each has its own `weights`.

    Args:
        scale: by which the disparity grows, a power of two from 2 up.
        guide_channels: of the guides at hand, by stride; the one at the disparity's is needed.
        stride: of the disparity; None for `scale`, which ends at full resolution.
        padding: outside the coarse map, see `superpixel_upsample`.

    Raises:
        ConfigError: there is no guide at this stride, the stride is no power of two, or the padding is unknown.
    """

    domain: Literal["disparity"] = "disparity"
    learned = True

    def __init__(self, *, scale: int, guide_channels: Mapping[int, int], stride: int | None, padding: Padding) -> None:
        super().__init__()
        if padding not in get_args(Padding):
            raise ConfigError(f"padding={padding!r} is unknown; use 'replicate' or 'zeros'")
        if scale < 2 or scale & (scale - 1):
            raise ConfigError(f"superpixel upsampling is by 2, 4, 8, ...; the disparity is to grow by {scale}")
        self.scale = scale
        self.stride = scale if stride is None else stride
        self.padding: Padding = padding
        if self.stride not in guide_channels:
            raise ConfigError(
                f"superpixel upsampling from stride {self.stride} wants a guide of that stride; there are guides at "
                f"{', '.join(map(str, guide_channels)) or 'none'}"
            )

    def weights(self, guides: Guides) -> Tensor:
        """Superpixel weights (B, 9, H, W), which sum to 1."""
        raise NotImplementedError

    def forward(self, x: Tensor, guides: Guides) -> Tensor:
        """(B, h, w) to (B, H, W)."""
        return superpixel_upsample(x, self.weights(guides), padding=self.padding)


@UPSAMPLERS.register("superpixel")
class SuperpixelUpsampler(Superpixels):
    """Predicts superpixel weights from the guides and upsamples the disparity with them.

    From the guide at the disparity's stride, a small decoder doubles the size until it is full; it takes in the guides
    of the finer strides on its way.

    Args:
        scale: by which the disparity grows, a power of two from 2 up.
        guide_channels: of the guides at hand, by stride; the one at the disparity's is needed, finer ones are used.
        stride: of the disparity; None for `scale`, which ends at full resolution.
        padding: outside the coarse map, see `superpixel_upsample`.
        norm: of all layers.
        channels: of the stem and of the decoder.
        activation: of all layers, see `named_activation`.
        stem_activation: of the second convolution of the stem.
        up_kernel: of the transposed convolutions but the last, 3 or 4.

    Shape: disparity (B, h, w) and guides by stride to (B, h * scale, w * scale), values not scaled.

    Raises:
        ConfigError: there is no guide at this stride, the stride is no power of two, or padding or an activation are
            unknown.

    Source: CoEx, section "Top-k disparity regression".

    >>> upsampler = SuperpixelUpsampler(scale=4, guide_channels={2: 32, 4: 96})
    >>> guides = {2: torch.rand(1, 32, 16, 32), 4: torch.rand(1, 96, 8, 16)}
    >>> upsampler(torch.rand(1, 8, 16), guides).shape
    torch.Size([1, 32, 64])
    """

    def __init__(
        self,
        *,
        scale: int,
        guide_channels: Mapping[int, int],
        stride: int | None = None,
        padding: Padding = "replicate",
        norm: Norm = "batch",
        channels: Sequence[int] = (24, 32),
        activation: str = "leaky_relu",
        stem_activation: str = "relu",
        up_kernel: int = 4,
    ) -> None:
        super().__init__(scale=scale, guide_channels=guide_channels, stride=stride, padding=padding)
        conv = partial(ConvNormAct, norm=norm, activation=named_activation(activation))
        stem, width = channels
        stride = self.stride
        self.strides = [stride >> i for i in range(1, scale.bit_length() - 1)]
        self.guide_channels = {s: guide_channels[s] for s in (stride, *self.strides) if s in guide_channels}
        self.stem = nn.Sequential(
            conv(guide_channels[stride], stem), conv(stem, stem, activation=named_activation(stem_activation))
        )
        self.up = nn.ModuleList()
        self.merge = nn.ModuleList()
        given = stem
        for stride in self.strides:
            self.up.append(conv(given, width, up_kernel, stride=2, transposed=True))
            given = width + self.guide_channels.get(stride, 0)
            self.merge.append(conv(given, given))
        self.head = nn.ConvTranspose2d(given, 9, 4, stride=2, padding=1)
        init_convolutions(self.head)

    def weights(self, guides: Guides) -> Tensor:
        """Superpixel weights (B, 9, H, W), which sum to 1."""
        x = self.stem(guides[self.stride])
        for stride, up, merge in zip(self.strides, self.up, self.merge, strict=True):
            x = up(x)
            if stride in self.guide_channels:
                x = torch.cat((crop_to(x, guides[stride]), guides[stride]), dim=1)
            x = merge(x)
        return at_least_float32(self.head(x)).softmax(1)
