"""The learned cost volume of PDS-Net: a small network that compares the views at one disparity after the other."""

import torch
from einops import rearrange
from torch import Tensor, nn

from stereokit.costs.shift import check_features, seen_from_left
from stereokit.layers import ActNormResidual, init_convolutions
from stereokit.registry import COSTS

__all__ = ["MatchingNetwork"]

PLANES_AT_ONCE = 8
"""In eval mode: all of them at once take much memory, and are no faster."""


@COSTS.register("matching_network")
class MatchingNetwork(nn.Module):
    r"""What a 2D network makes of the left features beside the right ones that they would match, at each disparity.

    .. math:: C(:, d) = f([l, r_d]), \quad r_d(y, x) = r(y, x - d), \quad 0 \text{ where } x < d

    with f a 3x3 convolution, two residual blocks and another 3x3 convolution. The planes of disparity are a batch, so
    that the instance norms keep to one plane. The first convolution is the sum of one over the left features, which is
    the same at every disparity, and one over the right ones.

    Args:
        in_channels: of the features.
        planes: of disparity.
        width: of the network.
        out_channels: of the volume.
        blocks: residual ones.

    Shape: two (B, in_channels, H, W) to (B, out_channels, planes, H, W).

    Source: Tulyakov et al., "Practical Deep Stereo (PDS): toward applications-friendly deep stereo matching",
    NeurIPS 2018, section 3.1, "bottleneck matching".

    >>> cost = MatchingNetwork(in_channels=64, planes=12)
    >>> cost(torch.rand(1, 64, 4, 16), torch.rand(1, 64, 4, 16)).shape
    torch.Size([1, 8, 12, 4, 16])
    """

    warps = True

    def __init__(
        self, *, in_channels: int, planes: int, width: int = 64, out_channels: int = 8, blocks: int = 2
    ) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.planes = planes
        self.out_channels = out_channels
        self.of_left = nn.Conv2d(in_channels, width, 3, padding=1)
        self.of_right = nn.Conv2d(in_channels, width, 3, padding=1, bias=False)
        self.blocks = nn.Sequential(*(ActNormResidual(width) for _ in range(blocks)))
        self.head = nn.Conv2d(width, out_channels, 3, padding=1)
        for conv in (self.of_left, self.of_right, self.head):
            init_convolutions(conv)

    def forward(self, left: Tensor, right: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Left and right features to a cost volume."""
        planes = self.planes if candidates is None else candidates
        check_features(left, right, planes)
        of_left = self.of_left(left).unsqueeze(2)
        shifted, _ = seen_from_left(right, planes)
        at_once = self.planes if self.training else PLANES_AT_ONCE
        return torch.cat([self._match(of_left, part) for part in torch.split(shifted, at_once, dim=2)], dim=2)

    def _match(self, of_left: Tensor, shifted: Tensor) -> Tensor:
        """Each plane by itself: (B, width, 1, H, W) and (B, C, D, H, W) to (B, out_channels, D, H, W)."""
        batch = len(shifted)
        of_right = self.of_right(rearrange(shifted, "b c d h w -> (b d) c h w"))
        both = of_left + rearrange(of_right, "(b d) c h w -> b c d h w", b=batch)
        signatures = self.head(self.blocks(rearrange(both, "b c d h w -> (b d) c h w")))
        return rearrange(signatures, "(b d) c h w -> b c d h w", b=batch)
