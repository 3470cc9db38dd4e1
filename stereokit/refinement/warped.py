"""The refinement of AANet: a residual from how far the right image, warped by the disparity, is from the left one."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import Guides
from stereokit.errors import ConfigError
from stereokit.layers import (
    ConvNormAct,
    DeformableConvolution,
    ResidualBlock,
    TwofoldHourglass,
    at_least_float32,
    leaky_relu,
    warp,
)
from stereokit.registry import REFINEMENTS

__all__ = ["WarpedRefinement"]

Body = Literal["dilated", "hourglass"]


@REFINEMENTS.register("warped")
class WarpedRefinement(nn.Module):
    r"""Adds a residual, computed from the disparity, the left image, and its difference from the warped right one.

    .. math:: \hat d = s \max(0, d' + r(d', I_l, w_{d'}(I_r) - I_l)), \quad d' = \uparrow d / s

    The disparity, at the stride s of the refinement or at a coarser one, and the images are brought to that stride
    bilinearly; there, the disparity is in pixels of the maps.

    Args:
        stride: s, of what comes out.
        body: of the residual: "dilated" residual blocks as StereoNet has them, or GA-Net's double "hourglass" with
            deformable convolutions.
        dilations: of the residual blocks, one each; for "dilated" alone.
        loss_weight: of its disparity, in training.

    Shape: disparity (B, h, w) and images (B, 3, H, W) to (B, H / stride, W / stride). With an hourglass, those are
    multiples of 16. The guides are not used.

    Raises:
        ConfigError: a stride that is no positive whole number, another body, or dilations for an hourglass.

    Source: Xu and Zhang, "AANet: adaptive aggregation network for efficient stereo matching", CVPR 2020, section 3.4,
    and AANet+ (haofeixu/aanet); Chabra et al., "StereoDRNet: dilated residual StereoNet", CVPR 2019, section 3.4.

    >>> left, right = torch.rand(2, 1, 3, 24, 36)
    >>> WarpedRefinement(stride=2)(torch.rand(1, 8, 12), left, right, {}).shape
    torch.Size([1, 12, 18])
    """

    def __init__(
        self,
        *,
        stride: int = 1,
        body: Body = "dilated",
        dilations: Sequence[int] | None = None,
        loss_weight: float = 1.0,
    ) -> None:
        super().__init__()
        if isinstance(stride, bool) or not isinstance(stride, int) or stride < 1:
            raise ConfigError(f"stride={stride!r} of a refinement has to be a whole number from 1 up")
        if body not in get_args(Body):
            raise ConfigError(f"body={body!r} of a refinement is unknown; use 'dilated' or 'hourglass'")
        if body == "hourglass" and dilations is not None:
            raise ConfigError(f"dilations={dilations!r} have no effect with the body 'hourglass'; leave them out")
        self.stride = stride
        self.loss_weight = loss_weight
        self.guide_channels: Mapping[int, int] = {}
        leaky = partial(leaky_relu, 0.2)
        self.of_images = ConvNormAct(6, 16, activation=leaky)
        self.of_disparity = ConvNormAct(1, 16, activation=leaky)
        self.multiple = 1
        if body == "hourglass":
            hourglass = TwofoldHourglass(deformable=True)
            self.multiple = hourglass.multiple
            self.body = nn.Sequential(DeformableConvolution(32, 32), hourglass)
        else:
            self.body = nn.Sequential(
                *(
                    ResidualBlock(32, 32, dilation=dilation, activation=leaky, after_sum=leaky)
                    for dilation in dilations or (1, 2, 4, 8, 1, 1)
                )
            )
        # the initialisation of PyTorch, so that a residual begins small
        self.head = nn.Conv2d(32, 1, 3, padding=1)

    def forward(self, disparity: Tensor, left: Tensor, right: Tensor, guides: Guides) -> Tensor:
        """A disparity, and the normalised images, to a better disparity."""
        size = (left.shape[-2] // self.stride, left.shape[-1] // self.stride)
        if self.stride > 1:
            left, right = (F.interpolate(x, size, mode="bilinear", align_corners=False) for x in (left, right))
        before = F.interpolate(disparity.unsqueeze(1), size, mode="bilinear", align_corners=False) / self.stride
        apart = warp(right, before, outside="border").squeeze(2) - left
        given = self.of_images(torch.cat((apart, left), dim=1)), self.of_disparity(before.to(left.dtype))
        residual = at_least_float32(self.head(self.body(torch.cat(given, dim=1))))
        return F.relu(before + residual).squeeze(1) * self.stride

    def extra_repr(self) -> str:
        """The stride, for printing."""
        return f"stride={self.stride}"
