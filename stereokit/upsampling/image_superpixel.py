"""Superpixel upsampling whose weights see the image itself: the upsampler of LightStereo."""

from collections.abc import Mapping

from torch import Tensor, nn

from stereokit.contracts import Guides
from stereokit.errors import ConfigError
from stereokit.layers import (
    ConvNormAct,
    UpStep,
    at_least_float32,
    image_stem,
    init_convolutions,
    named_activation,
    relu,
)
from stereokit.registry import UPSAMPLERS
from stereokit.upsampling.superpixel import Padding, Superpixels

__all__ = ["ImageSuperpixelUpsampler"]


@UPSAMPLERS.register("image_superpixel")
class ImageSuperpixelUpsampler(Superpixels):
    """Predicts superpixel weights from a guide and the image, and upsamples the disparity with them.

    From the guide at the disparity's stride, a small decoder doubles the size until it is full. At stride 2 it takes in
    a stem of its own on the image, where there are coarser strides on its way the guides of these.

    Args:
        scale: by which the disparity grows, a power of two from 4 up; it ends at full resolution.
        guide_channels: of the guides at hand, by stride; needed from the disparity's down to 4, and the image at 1.
        stride: of the disparity; None for `scale`.
        channels: of the stem on the image, and of the decoder.
        padding: outside the coarse map, see `superpixel_upsample`.

    Shape: disparity (B, h, w) and guides by stride to (B, h * scale, w * scale), values not scaled.

    Raises:
        ConfigError: a guide is missing, the stride is no power of two from 4 up, the upsampling ends before full
            resolution, or the padding is unknown.

    Source: Guo et al., "LightStereo: channel boost is all you need for efficient 2D cost aggregation", ICRA 2025; the
    weighted mean is that of CoEx, see `superpixel_upsample`.

    >>> import torch
    >>> upsampler = ImageSuperpixelUpsampler(scale=4, guide_channels={1: 3, 4: 24})
    >>> guides = {1: torch.rand(1, 3, 32, 64), 4: torch.rand(1, 24, 8, 16)}
    >>> upsampler(torch.rand(1, 8, 16), guides).shape
    torch.Size([1, 32, 64])
    """

    def __init__(
        self,
        *,
        scale: int,
        guide_channels: Mapping[int, int],
        stride: int | None = None,
        channels: int = 16,
        padding: Padding = "replicate",
    ) -> None:
        super().__init__(scale=scale, guide_channels=guide_channels, stride=stride, padding=padding)
        if scale < 4 or scale != self.stride:
            raise ConfigError(
                "image_superpixel takes a disparity of stride 4, 8, ... to full resolution; it is to grow by "
                f"{scale} from stride {self.stride}: use 'superpixel'"
            )
        between = [self.stride >> i for i in range(1, scale.bit_length() - 2)]
        missing = [str(s) for s in (1, *between) if s not in guide_channels]
        if missing:
            raise ConfigError(
                f"image_superpixel from stride {self.stride} wants guides at stride {', '.join(missing)} too; there "
                f"are guides at {', '.join(map(str, guide_channels))}"
            )
        self.guide_channels = {s: guide_channels[s] for s in (self.stride, *between, 1)}
        self.between = between
        width = guide_channels[self.stride]
        self.refine = nn.Sequential(
            ConvNormAct(width, width, norm="instance"), ConvNormAct(width, width, norm="instance", activation=relu)
        )
        self.image_stem = image_stem(guide_channels[1], channels)
        self.up = nn.ModuleList()
        for skip in (*(guide_channels[s] for s in between), channels):
            self.up.append(UpStep(width, skip, skip, activation=named_activation("leaky_relu_0.2"), skip_first=True))
            width = skip
        self.head = nn.ConvTranspose2d(channels, 9, 4, stride=2, padding=1, bias=False)
        init_convolutions(self.head)

    def weights(self, guides: Guides) -> Tensor:
        """Superpixel weights (B, 9, H, W), which sum to 1."""
        x = self.refine(guides[self.stride])
        skips = (*(guides[s] for s in self.between), self.image_stem(guides[1]))
        for up, skip in zip(self.up, skips, strict=True):
            x = up(x, skip)
        return at_least_float32(self.head(x)).softmax(1)
