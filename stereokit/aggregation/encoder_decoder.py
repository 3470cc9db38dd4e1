"""The cost aggregation of GC-Net: a deep encoder-decoder that ends at full resolution."""

from collections.abc import Mapping

from torch import Tensor, nn

from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.guidance.point import GuidancePlan, GuidancePoint
from stereokit.layers import ConvNormAct, crop_to, init_convolutions, relu
from stereokit.registry import AGGREGATIONS

__all__ = ["EncoderDecoder"]


class Level(nn.Module):
    """One scale of the encoder: what goes down to the next scale, and two convolutions on it for the skip."""

    def __init__(self, in_channels: int, channels: int, guidance: GuidancePoint) -> None:
        super().__init__()
        self.down = ConvNormAct(in_channels, channels, dims=3, stride=2, activation=relu)
        self.guidance = guidance
        self.skip = conv_pair(channels, channels)

    def forward(self, x: Tensor, guides: Guides) -> tuple[Tensor, Tensor]:
        """(B, in_channels, D, H, W) to two (B, channels, D/2, H/2, W/2): for the next scale, and for the decoder."""
        x = self.guidance(self.down(x), guides)
        return x, self.skip(x)


class UpLevel(nn.Module):
    """One scale of the decoder: double the volume, add the skip, guide."""

    def __init__(self, in_channels: int, channels: int, guidance: GuidancePoint) -> None:
        super().__init__()
        self.up = ConvNormAct(in_channels, channels, dims=3, stride=2, transposed=True, activation=relu)
        self.guidance = guidance

    def forward(self, x: Tensor, skip: Tensor, guides: Guides) -> Tensor:
        """(B, in_channels, D, H, W) and a skip (B, channels, 2D, 2H, 2W) to the skip's shape."""
        return self.guidance(crop_to(self.up(x), skip) + skip, guides)


def conv_pair(in_channels: int, channels: int) -> nn.Sequential:
    """Two 3x3x3 convolutions."""
    return nn.Sequential(
        ConvNormAct(in_channels, channels, dims=3, activation=relu),
        ConvNormAct(channels, channels, dims=3, activation=relu),
    )


@AGGREGATIONS.register("encoder_decoder")
class EncoderDecoder(nn.Module):
    """Four halvings and five doublings: the logits are twice as fine as the volume.

    Guidance at "one" place acts on the volume itself; "full" adds every scale of the encoder and of the decoder.

    Args:
        in_channels: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; needed at `stride` times 1, 2, 4, 8 and 16 for "full".
        guidance: makes a guidance block, such as `GCE`; None for none.
        guidance_at: "one" or "full".
        channels: of the finest scale; twice that below it, four times at the bottom.

    Shape: volume (B, in_channels, D, H, W) and guides by stride to one tensor (B, 2D, 2H, 2W) of logits, larger is
    better.

    Source: Kendall et al., "End-to-end learning of geometry and context for deep stereo regression", ICCV 2017,
    table 1, layers 19 to 37.

    >>> import torch
    >>> EncoderDecoder(in_channels=16, channels=4)(torch.rand(1, 16, 16, 16, 32), {})[-1].shape
    torch.Size([1, 32, 32, 64])
    """

    multiple = planes_multiple = 16
    upscale = 2
    loss_weights = (1.0,)
    volume_heads = ("head",)

    def __init__(
        self,
        *,
        in_channels: int,
        stride: int = 2,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "one",
        channels: int = 32,
    ) -> None:
        super().__init__()
        self.in_channels = in_channels
        c = channels
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)

        self.volume_guidance = plan.first(in_channels)
        self.skip0 = conv_pair(in_channels, c)
        self.down1 = Level(in_channels, 2 * c, plan.at(2, 2 * c))
        self.down2 = Level(2 * c, 2 * c, plan.at(4, 2 * c))
        self.down3 = Level(2 * c, 2 * c, plan.at(8, 2 * c))
        self.down4 = Level(2 * c, 4 * c, plan.at(16, 4 * c))
        self.up3 = UpLevel(4 * c, 2 * c, plan.at(8, 2 * c))
        self.up2 = UpLevel(2 * c, 2 * c, plan.at(4, 2 * c))
        self.up1 = UpLevel(2 * c, 2 * c, plan.at(2, 2 * c))
        self.up0 = UpLevel(2 * c, c, plan.at(1, c))
        self.head = nn.ConvTranspose3d(c, 1, 3, stride=2, padding=1, output_padding=1, bias=False)
        init_convolutions(self.head)
        self.guide_channels = GuidancePlan.guides_read_by(self)

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """Volume and guides to logits."""
        volume = self.volume_guidance(volume, guides)
        skip0 = self.skip0(volume)
        x, skip1 = self.down1(volume, guides)
        x, skip2 = self.down2(x, guides)
        x, skip3 = self.down3(x, guides)
        _, bottom = self.down4(x, guides)
        x = self.up3(bottom, skip3, guides)
        x = self.up2(x, skip2, guides)
        x = self.up1(x, skip1, guides)
        x = self.up0(x, skip0, guides)
        return (self.head(x).squeeze(1),)
