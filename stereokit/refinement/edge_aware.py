"""The refinement of StereoNet: a residual that the image guides."""

from collections.abc import Mapping, Sequence
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.contracts import Guides
from stereokit.errors import ConfigError
from stereokit.layers import ConvNormAct, ResidualBlock, leaky_relu
from stereokit.registry import REFINEMENTS

__all__ = ["EdgeAwareRefinement"]


@REFINEMENTS.register("edge_aware")
class EdgeAwareRefinement(nn.Module):
    r"""Adds a residual, computed from the disparity and the image by dilated convolutions.

    .. math:: \hat d = \max(0, \uparrow d + r(\uparrow d, \downarrow I))

    The disparity, at the stride of the refinement or at a coarser one, and the image are brought to that stride
    bilinearly. Values stay pixels of the full-size image.

    Args:
        stride: of what comes out.
        channels: of every layer.
        dilations: of the residual blocks, one each.
        align_corners: the middles of the corner pixels lie upon each other when maps are resized, as in published
            weights, in place of the corners themselves.
        loss_weight: of its disparity, in training.

    Shape: disparity (B, h, w) and the left image (B, 3, H, W) to (B, H / stride, W / stride). The right image and the
    guides are not used.

    Raises:
        ConfigError: a stride that is no positive whole number.

    Source: Khamis et al., "StereoNet: guided hierarchical refinement for real-time edge-aware depth prediction",
    ECCV 2018, section 3.4.

    >>> left, right = torch.rand(2, 1, 3, 32, 48)
    >>> EdgeAwareRefinement(stride=2)(torch.rand(1, 4, 6), left, right, {}).shape
    torch.Size([1, 16, 24])
    """

    def __init__(
        self,
        *,
        stride: int = 1,
        channels: int = 32,
        dilations: Sequence[int] = (1, 2, 4, 8, 1, 1),
        align_corners: bool = False,
        loss_weight: float = 1.0,
    ) -> None:
        super().__init__()
        if isinstance(stride, bool) or not isinstance(stride, int) or stride < 1:
            raise ConfigError(f"stride={stride!r} of a refinement has to be a whole number from 1 up")
        self.stride = stride
        self.align_corners = align_corners
        self.loss_weight = loss_weight
        self.guide_channels: Mapping[int, int] = {}
        leaky = partial(leaky_relu, 0.2)
        self.stem = ConvNormAct(3 + 1, channels, bias=True, norm=None, activation=None)
        self.blocks = nn.Sequential(
            *(
                ResidualBlock(channels, channels, dilation=dilation, activation=leaky, after_sum=leaky)
                for dilation in dilations
            )
        )
        # the initialisation of PyTorch, so that a residual begins small
        self.head = nn.Conv2d(channels, 1, 3, padding=1)

    def forward(self, disparity: Tensor, left: Tensor, right: Tensor, guides: Guides) -> Tensor:
        """A disparity, and the normalised images, to a better disparity."""
        height, width = left.shape[-2:]
        size = (height // self.stride, width // self.stride)
        image = left if self.stride == 1 else self._resized(left, size)
        before = self._resized(disparity.unsqueeze(1), size)
        residual = self.head(self.blocks(self.stem(torch.cat((image, before.to(image.dtype)), dim=1))))
        return F.relu(before + residual).squeeze(1)

    def _resized(self, x: Tensor, size: tuple[int, int]) -> Tensor:
        return F.interpolate(x, size, mode="bilinear", align_corners=self.align_corners)

    def extra_repr(self) -> str:
        """The stride, for printing."""
        return f"stride={self.stride}"
