"""The feature extractor of CoEx: a U-Net over any timm model."""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor, nn

from stereokit.backbones.encoder import build_encoder
from stereokit.contracts import FeatureInfo, Features
from stereokit.errors import ConfigError
from stereokit.layers import ConvNormAct, Norm, UpStep, image_stem, named_activation
from stereokit.registry import BACKBONES

__all__ = ["UNet"]


@BACKBONES.register("unet")
class UNet(nn.Module):
    """Encoder with a U-Net decoder, and a shallow stem that keeps the fine detail.

    The matching features are those at stride 4: decoder and stem concatenated. The guides are the stem at stride 2,
    the matching features at 4, the decoder at 8 and 16, and the encoder at 32.

    Args:
        encoder: a timm model with features at strides 4 to 32.
        stem_channels: of the stem at strides 2 and 4; a third number has it go on to stride 8, where it is
            concatenated to the decoder too, and matched.
        pretrained: load timm's weights for the encoder.
        norm: of decoder and stem.
        channels: of the decoder's map at stride 4; None for twice the encoder's.
        activation: of decoder and stem, see `named_activation`.
        stem_activation: of the second convolution at each stride of the stem.
        up_kernel: of the transposed convolutions of the decoder, 3 or 4.

    Shape: (B, 3, H, W), sides multiples of 32, to `Features`; with the default encoder the channels are
    96 (matching) and {2: 32, 4: 96, 8: 64, 16: 192, 32: 160} (guides).

    Raises:
        ConfigError: another number of stem channels, or an unknown activation.

    Source: CoEx, section "Matching cost computation"; the stem at stride 8 is that of Fast-ACVNet, kernels of 3
    are those of BANet.

    >>> UNet().eval()(torch.rand(1, 3, 64, 96)).matching[4].shape
    torch.Size([1, 96, 16, 24])
    """

    multiple = 32

    def __init__(
        self,
        *,
        encoder: str = "mobilenetv2_100",
        stem_channels: Sequence[int] = (32, 48),
        pretrained: bool = False,
        norm: Norm = "batch",
        channels: int | None = None,
        activation: str = "leaky_relu",
        stem_activation: str = "relu",
        up_kernel: int = 4,
    ) -> None:
        super().__init__()
        if len(stem_channels) not in (2, 3):
            raise ConfigError(f"stem_channels={stem_channels!r}: give two, at strides 2 and 4, or a third, at 8")
        stem2, stem4, *stem8 = stem_channels
        act = named_activation(activation)
        stem = partial(image_stem, norm=norm, activation=act, last_activation=named_activation(stem_activation))
        up = partial(UpStep, norm=norm, activation=act, kernel_size=up_kernel)
        self.encoder = build_encoder(encoder, pretrained=pretrained)
        skips = self.encoder.channels
        self.stem_2 = stem(3, stem2)
        self.stem_4 = stem(stem2, stem4)
        self.stem_8 = stem(stem4, sum(stem8), inner=stem4) if stem8 else None
        self.up_16 = up(skips[32], skips[16], 2 * skips[16])
        self.up_8 = up(self.up_16.out_channels, skips[8], 2 * skips[8])
        self.up_4 = up(self.up_8.out_channels, skips[4], 2 * skips[4])
        finest = self.up_4.out_channels if channels is None else channels
        self.merge_4 = ConvNormAct(self.up_4.out_channels, finest, norm=norm, activation=act)
        matching = finest + stem4
        eighth = self.up_8.out_channels + sum(stem8)
        self.info = FeatureInfo(
            matching_channels={4: matching, 8: eighth} if stem8 else {4: matching},
            guide_channels={
                2: stem2,
                4: matching,
                8: eighth,
                16: self.up_16.out_channels,
                32: skips[32],
            },
        )

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        stem_2 = self.stem_2(images)
        stem_4 = self.stem_4(stem_2)
        skips = self.encoder(images)
        x16 = self.up_16(skips[32], skips[16])
        x8 = self.up_8(x16, skips[8])
        x4 = self.merge_4(self.up_4(x8, skips[4]))
        x4 = torch.cat((x4, stem_4), dim=1)
        matching = {4: x4}
        if self.stem_8 is not None:
            x8 = matching[8] = torch.cat((x8, self.stem_8(stem_4)), dim=1)
        return Features(matching=matching, guides={2: stem_2, 4: x4, 8: x8, 16: x16, 32: skips[32]})
