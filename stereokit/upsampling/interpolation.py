"""Upsampling by interpolation: of the disparity, or of the logits before the regression."""

from collections.abc import Mapping
from typing import Literal

from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import Guides
from stereokit.layers import bilinear_upsample
from stereokit.registry import UPSAMPLERS

__all__ = [
    "BilinearUpsampler",
    "NoUpsampler",
    "TrilinearUpsampler",
    "trilinear_upsample",
]


def trilinear_upsample(
    logits: Tensor,
    scale: int,
    *,
    planes_scale: int | None = None,
    align_corners: bool = False,
    include_end: bool = False,
) -> Tensor:
    """Logits (B, D, h, w) to (B, D * planes_scale, h * scale, w * scale).

    Args:
        logits: (B, D, h, w).
        scale: of height and width, a whole number.
        planes_scale: of the planes; None for the same.
        align_corners: as in `bilinear_upsample`.
        include_end: the last plane is the end of the range, before and after: (D - 1) * planes_scale + 1 come of D.

    >>> import torch
    >>> trilinear_upsample(torch.rand(1, 6, 2, 3), 4).shape
    torch.Size([1, 24, 8, 12])
    """
    if include_end:
        planes, height, width = logits.shape[1:]
        levels = (planes - 1) * (scale if planes_scale is None else planes_scale) + 1
        size = (levels, height * scale, width * scale)
        return F.interpolate(logits.unsqueeze(1), size, mode="trilinear", align_corners=align_corners).squeeze(1)
    factors = (float(scale if planes_scale is None else planes_scale), float(scale), float(scale))
    return F.interpolate(
        logits.unsqueeze(1), scale_factor=factors, mode="trilinear", align_corners=align_corners
    ).squeeze(1)


class _Interpolation(nn.Module):
    learned = False

    def __init__(self, *, scale: int, align_corners: bool = False) -> None:
        super().__init__()
        self.scale = scale
        self.align_corners = align_corners
        self.guide_channels: Mapping[int, int] = {}

    def extra_repr(self) -> str:
        """The factor, for printing."""
        return f"scale={self.scale}"


@UPSAMPLERS.register("bilinear")
class BilinearUpsampler(_Interpolation):
    """`bilinear_upsample` of the disparity; the guides are not used.

    Args:
        scale: by which it grows: the stride of the disparity.
        align_corners: see `bilinear_upsample`.

    >>> import torch
    >>> BilinearUpsampler(scale=4)(torch.rand(1, 2, 3), {}).shape
    torch.Size([1, 8, 12])
    """

    domain: Literal["disparity"] = "disparity"

    def forward(self, x: Tensor, guides: Guides) -> Tensor:
        """(B, h, w) to (B, H, W)."""
        return bilinear_upsample(x, self.scale, align_corners=self.align_corners)


@UPSAMPLERS.register("trilinear")
class TrilinearUpsampler(_Interpolation):
    """`trilinear_upsample` of the logits, before the regression; the guides are not used.

    Args:
        scale: by which height and width grow: the stride of the logits.
        planes_scale: by which the planes grow; None for `scale`.
        align_corners: as in `bilinear_upsample`.
        include_end: see `trilinear_upsample`; for candidates that include their end.

    Source: Chang and Chen, "Pyramid Stereo Matching Network", CVPR 2018, section 3.4.

    >>> import torch
    >>> TrilinearUpsampler(scale=4)(torch.rand(1, 6, 2, 3), {}).shape
    torch.Size([1, 24, 8, 12])
    """

    domain: Literal["volume"] = "volume"

    def __init__(
        self,
        *,
        scale: int,
        planes_scale: int | None = None,
        align_corners: bool = False,
        include_end: bool = False,
    ) -> None:
        super().__init__(scale=scale, align_corners=align_corners)
        self.planes_scale = scale if planes_scale is None else planes_scale
        self.include_end = include_end

    def forward(self, x: Tensor, guides: Guides) -> Tensor:
        """(B, D, h, w) to (B, D * planes_scale, H, W)."""
        return trilinear_upsample(
            x,
            self.scale,
            planes_scale=self.planes_scale,
            align_corners=self.align_corners,
            include_end=self.include_end,
        )


@UPSAMPLERS.register("none")
class NoUpsampler(nn.Module):
    """For logits at full resolution: leaves the disparity as it is.

    >>> import torch
    >>> NoUpsampler()(torch.ones(1, 1, 2), {})
    tensor([[[1., 1.]]])
    """

    scale = 1
    domain: Literal["disparity"] = "disparity"
    learned = False

    def __init__(self) -> None:
        super().__init__()
        self.guide_channels: Mapping[int, int] = {}

    def forward(self, x: Tensor, guides: Guides) -> Tensor:
        """(B, H, W), unchanged."""
        return x
