"""The feature extractor of LightStereo: a slim feature pyramid over any timm model."""

from torch import Tensor, nn

from stereokit.backbones.encoder import build_encoder
from stereokit.contracts import FeatureInfo, Features
from stereokit.layers import ConvNormAct, UpStep, named_activation
from stereokit.registry import BACKBONES

__all__ = ["FeaturePyramid"]


@BACKBONES.register("feature_pyramid")
class FeaturePyramid(nn.Module):
    """Encoder with a decoder that keeps the encoder's widths, and an instance norm on the finest map.

    The matching features are those at stride 4. The guides are the matching features at 4, the decoder at 8 and 16, and
    the encoder at 32.

    Args:
        encoder: a timm model with features at strides 4 to 32.
        pretrained: load timm's weights for the encoder.

    Shape: (B, 3, H, W), sides multiples of 32, to `Features`; with the default encoder the channels are
    24 (matching) and {4: 24, 8: 32, 16: 96, 32: 160} (guides).

    Source: Guo et al., "LightStereo: channel boost is all you need for efficient 2D cost aggregation", ICRA 2025.

    >>> import torch
    >>> FeaturePyramid().eval()(torch.rand(1, 3, 64, 96)).matching[4].shape
    torch.Size([1, 24, 16, 24])
    """

    multiple = 32

    def __init__(self, *, encoder: str = "mobilenetv2_100", pretrained: bool = False) -> None:
        super().__init__()
        self.encoder = build_encoder(encoder, pretrained=pretrained)
        widths = self.encoder.channels
        self.up_16 = _up(widths[32], widths[16])
        self.up_8 = _up(widths[16], widths[8])
        self.up_4 = _up(widths[8], widths[4])
        self.head = ConvNormAct(widths[4], widths[4], norm="instance", activation=None, padding_mode="replicate")
        self.info = FeatureInfo(matching_channels={4: widths[4]}, guide_channels=dict(widths))

    def forward(self, images: Tensor) -> Features:
        """Images to features."""
        skips = self.encoder(images)
        x16 = self.up_16(skips[32], skips[16])
        x8 = self.up_8(x16, skips[8])
        x4 = self.head(self.up_4(x8, skips[4]))
        return Features(matching={4: x4}, guides={4: x4, 8: x8, 16: x16, 32: skips[32]})


def _up(in_channels: int, width: int) -> UpStep:
    return UpStep(in_channels, width, width, activation=named_activation("leaky_relu_0.2"), skip_first=True)
