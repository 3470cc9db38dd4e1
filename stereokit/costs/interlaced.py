"""The interlaced cost volume of MobileStereoNet: matching learned on channels of both views in turn."""

import math
from collections.abc import Sequence

import torch
from einops import rearrange
from torch import Tensor, nn

from stereokit.costs.shift import Planes, check_features, seen_from_left
from stereokit.errors import ConfigError
from stereokit.layers import ConvNormAct, init_convolutions, relu
from stereokit.registry import COSTS

__all__ = ["InterlacedVolume", "interlaced_volume"]

PLANES_AT_ONCE = 8
"""In eval mode: all of them at once take much memory, and are no faster."""


def interlaced_volume(left: Tensor, right: Tensor, planes: Planes) -> tuple[Tensor, Tensor]:
    """Channels of the left features and of the right ones that they would match, in turn, at every disparity.

    ``V(2c, d, y, x) = l_c(y, x)`` and ``V(2c + 1, d, y, x) = r_c(y, x - d)``, both 0 where x < d.

    Args:
        left: l, (B, C, H, W).
        right: r, (B, C, H, W).
        planes: D, for the disparities 0 ... D - 1, or candidates (B, D, H, W); in pixels of the maps.

    Returns:
        V, (B, 2C, D, H, W); and (B, 1, D, H, W), 0 where x < d, else 1.

    Raises:
        InputError: the maps are not a pair.

    Source: Shamsafar et al., "MobileStereoNet: towards lightweight deep networks for stereo matching", WACV 2022,
    "Interlacing cost volume construction".

    >>> volume, seen = interlaced_volume(torch.ones(1, 1, 1, 3), 2 * torch.ones(1, 1, 1, 3), 2)
    >>> volume[0, :, 1, 0]
    tensor([[0., 1., 1.],
            [0., 2., 2.]])
    """
    check_features(left, right, planes)
    shifted, seen = seen_from_left(right, planes)
    seen = seen.expand(len(shifted), 1, *shifted.shape[2:])
    pair = torch.stack((left.unsqueeze(2).expand_as(shifted), shifted), dim=2)
    return pair.flatten(1, 2) * seen, seen


class SeenConvolution(nn.Module):
    """A convolution, a batch norm and a ReLU where there is something to see; 0 elsewhere.

    Args:
        conv: of maps or volumes.

    Shape: (N, C, ..., H, W) and a mask (N, 1, ..., H, W) to (N, C', ..., H, W).
    """

    def __init__(self, conv: nn.Conv2d | nn.Conv3d) -> None:
        super().__init__()
        init_convolutions(conv)
        self.conv = conv
        norm = nn.BatchNorm2d if isinstance(conv, nn.Conv2d) else nn.BatchNorm3d
        self.norm = norm(conv.out_channels)
        self.activation = relu()

    def forward(self, x: Tensor, seen: Tensor) -> Tensor:
        """The statistics of training are those of what is seen."""
        x = self.conv(x)
        x = self._norm_of(x, seen.expand_as(x[:, :1])) if self.training else self.norm(x)
        return self.activation(x) * seen

    def _norm_of(self, x: Tensor, seen: Tensor) -> Tensor:
        rows = x.movedim(1, -1)
        there = seen.squeeze(1) > 0
        normed = self.norm(rows[there].reshape(-1, x.shape[1], *(1,) * (x.dim() - 2)))
        filled = torch.zeros(rows.shape, dtype=normed.dtype, device=x.device)
        filled[there] = normed.flatten(1)
        return filled.movedim(-1, 1)


@COSTS.register("interlaced")
class InterlacedVolume(nn.Module):
    """`interlaced_volume` of reduced features, brought to one channel by convolutions that take its channels in groups.

    Each disparity is matched by itself, with the same weights: three 3D convolutions over (channels, H, W), whose
    kernels lie side by side along the channels. The published network matches one disparity after the other, and in
    training normalises each by its own statistics; here they are a batch, with common statistics over all pixels that
    have a partner.

    Args:
        in_channels: of the features.
        planes: of disparity.
        reduction: channels of the 1x1 convolutions ahead, the last one plain.
        kernels: along the interlaced channels; their product is the number of these.
        channels: of the three convolutions.

    Shape: two (B, in_channels, H, W) to (B, 1, planes, H, W), nowhere below 0.

    Raises:
        ConfigError: kernels whose product is not twice the last of `reduction`, or not one for each of `channels`.

    Source: Shamsafar et al., WACV 2022, "Interlacing cost volume construction".

    >>> cost = InterlacedVolume(in_channels=320, planes=12).eval()
    >>> cost(torch.rand(1, 320, 4, 16), torch.rand(1, 320, 4, 16)).shape
    torch.Size([1, 1, 12, 4, 16])
    """

    out_channels = 1
    warps = True

    def __init__(
        self,
        *,
        in_channels: int,
        planes: int,
        reduction: Sequence[int] = (256, 128, 64, 32),
        kernels: Sequence[int] = (8, 4, 2),
        channels: Sequence[int] = (16, 32, 16),
    ) -> None:
        super().__init__()
        if not reduction or len(kernels) != len(channels) or math.prod(kernels) != 2 * reduction[-1]:
            raise ConfigError(
                f"kernels={list(kernels)} for channels={list(channels)}: expected one for each, of the product "
                f"{2 * reduction[-1] if reduction else 'of'} (twice the last of reduction={list(reduction)})"
            )
        self.in_channels = in_channels
        self.planes = planes
        widths = (in_channels, *reduction)
        last = nn.Conv2d(widths[-2], widths[-1], 1)
        init_convolutions(last)
        self.reduction = nn.Sequential(
            *(ConvNormAct(a, b, 1, activation=relu) for a, b in zip(widths[:-2], reduction, strict=False)), last
        )
        self.layers = nn.ModuleList(
            SeenConvolution(nn.Conv3d(a, b, (k, 3, 3), stride=(k, 1, 1), padding=(0, 1, 1)))
            for a, b, k in zip((1, *channels), channels, kernels, strict=False)
        )
        self.merge = SeenConvolution(nn.Conv2d(channels[-1], 1, 1, bias=False))

    def forward(self, left: Tensor, right: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Left and right features to a cost volume."""
        left, right = self.reduction(torch.cat((left, right))).chunk(2)
        volume, seen = interlaced_volume(left, right, self.planes if candidates is None else candidates)
        at_once = self.planes if self.training else PLANES_AT_ONCE
        parts = zip(torch.split(volume, at_once, dim=2), torch.split(seen, at_once, dim=2), strict=True)
        return torch.cat([self._match(*part) for part in parts], dim=2)

    def _match(self, volume: Tensor, seen: Tensor) -> Tensor:
        """Each plane by itself: (B, 2C, D, H, W) to (B, 1, D, H, W)."""
        batch = len(volume)
        x = rearrange(volume, "b c d h w -> (b d) 1 c h w")
        seen = rearrange(seen, "b 1 d h w -> (b d) 1 h w")
        for layer in self.layers:
            x = layer(x, seen.unsqueeze(2))
        return rearrange(self.merge(x.squeeze(2), seen), "(b d) 1 h w -> b 1 d h w", b=batch)
