"""Convex upsampling: superpixel weights that one coarse map predicts for all pixels of its cells."""

from collections.abc import Mapping

from einops import rearrange
from torch import Tensor, nn

from stereokit.contracts import Guides
from stereokit.layers import at_least_float32
from stereokit.registry import UPSAMPLERS
from stereokit.upsampling.superpixel import Padding, Superpixels

__all__ = ["ConvexUpsampler", "ConvexWeights"]


class ConvexWeights(nn.Module):
    """A coarse map to the weights of each fine pixel's 3x3 coarse neighbours.

    Args:
        in_channels: of the map.
        scale: fine pixels on a side of a coarse one.
        channels: between the two convolutions.

    Shape: (B, in_channels, h, w) to (B, 9, h * scale, w * scale), which sum to 1: see `superpixel_upsample`.

    Source: Teed and Deng, "RAFT: recurrent all-pairs field transforms for optical flow", ECCV 2020, section 3.3.

    >>> import torch
    >>> weights = ConvexWeights(8, 4)(torch.rand(1, 8, 3, 5))
    >>> weights.shape, torch.allclose(weights.sum(1), torch.ones(1, 12, 20))
    (torch.Size([1, 9, 12, 20]), True)
    """

    def __init__(self, in_channels: int, scale: int, channels: int = 256) -> None:
        super().__init__()
        self.scale = scale
        self.layers = nn.Sequential(
            nn.Conv2d(in_channels, channels, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(channels, 9 * scale**2, 1),
        )

    def forward(self, x: Tensor) -> Tensor:
        """A coarse map to weights."""
        # a quarter balances the gradients, as in the published networks
        logits = 0.25 * at_least_float32(self.layers(x))
        by_neighbor = rearrange(logits, "b (k s) h w -> b k s h w", k=9).softmax(1)
        return rearrange(by_neighbor, "b k (sy sx) h w -> b k (h sy) (w sx)", sy=self.scale)


@UPSAMPLERS.register("convex")
class ConvexUpsampler(Superpixels):
    """Superpixel upsampling whose weights come from the guide at the disparity's stride alone.

    Args:
        scale: by which the disparity grows, a power of two from 2 up.
        guide_channels: of the guides at hand, by stride; the one at the disparity's is needed.
        stride: of the disparity; None for `scale`, which ends at full resolution.
        channels: between the two convolutions that make the weights.
        padding: outside the coarse map, see `superpixel_upsample`; "zeros" in RAFT-Stereo.

    Shape: disparity (B, h, w) and guides by stride to (B, h * scale, w * scale), values not scaled.

    Raises:
        ConfigError: there is no guide at this stride, the stride is no power of two, or the padding is unknown.

    Source: Teed and Deng, "RAFT", ECCV 2020, section 3.3.

    >>> import torch
    >>> upsampler = ConvexUpsampler(scale=4, guide_channels={4: 96})
    >>> upsampler(torch.rand(1, 8, 16), {4: torch.rand(1, 96, 8, 16)}).shape
    torch.Size([1, 32, 64])
    """

    def __init__(
        self,
        *,
        scale: int,
        guide_channels: Mapping[int, int],
        stride: int | None = None,
        channels: int = 256,
        padding: Padding = "replicate",
    ) -> None:
        super().__init__(scale=scale, guide_channels=guide_channels, stride=stride, padding=padding)
        self.guide_channels = {self.stride: guide_channels[self.stride]}
        self.predict = ConvexWeights(guide_channels[self.stride], scale, channels)

    def weights(self, guides: Guides) -> Tensor:
        """Superpixel weights (B, 9, H, W), which sum to 1."""
        weights: Tensor = self.predict(guides[self.stride])
        return weights
