"""Multi-Scale Convolutional Attention (MSCA): strips of three lengths over the image features scale a cost volume."""

from collections.abc import Sequence

from torch import Tensor, nn

from stereokit.errors import ConfigError
from stereokit.guidance.shapes import check_guide
from stereokit.registry import GUIDANCE

__all__ = ["MSCA"]


@GUIDANCE.register("msca")
class MSCA(nn.Module):
    r"""Image features, gathered along rows and columns, scale the channels of the cost volume.

    .. math::
        a = W_1 I, \qquad
        C_o = W_2 \Bigl(a + \sum_n S_{n \times 1} S_{1 \times n} a\Bigr) \times C_i

    The strips S convolve each channel by itself, :math:`1 \times n` along the row first. In contrast to `GCE` the
    factor is not bounded, and may be negative; it starts small, as PyTorch's initialisation has it: no norm follows.

    Args:
        guide_channels: of the image features I.
        volume_channels: of the cost volume.
        lengths: n of the strips, odd.

    Shape: volume (B, volume_channels, D, H, W) and guide (B, guide_channels, H, W) to the volume's shape.

    Raises:
        ConfigError: a length is even.
        InputError: in its forward, volume and guide of other channels, or of sizes that differ.

    Source: Guo et al., "LightStereo", ICRA 2025; Guo et al., "SegNeXt", NeurIPS 2022.

    >>> import torch
    >>> msca = MSCA(guide_channels=24, volume_channels=48)
    >>> msca(torch.rand(2, 48, 1, 16, 32), torch.rand(2, 24, 16, 32)).shape
    torch.Size([2, 48, 1, 16, 32])
    """

    def __init__(self, guide_channels: int, volume_channels: int, *, lengths: Sequence[int] = (7, 11, 21)) -> None:
        super().__init__()
        if any(n < 1 or n % 2 == 0 for n in lengths):
            raise ConfigError(f"lengths={tuple(lengths)}: a strip has a centre; use odd lengths such as 7, 11, 21")
        self.guide_channels = guide_channels
        self.volume_channels = volume_channels
        self.project = nn.Conv2d(guide_channels, volume_channels, 1)
        self.strips = nn.ModuleList(
            nn.Sequential(_strip(volume_channels, 1, n), _strip(volume_channels, n, 1)) for n in lengths
        )
        self.mix = nn.Conv2d(volume_channels, volume_channels, 1)

    def factors(self, guide: Tensor) -> Tensor:
        """What the channels of the volume are multiplied with, (B, volume_channels, H, W)."""
        projected = total = self.project(guide)
        for strip in self.strips:
            total = total + strip(projected)
        return self.mix(total)

    def forward(self, volume: Tensor, guide: Tensor) -> Tensor:
        """Volume and guide to the scaled volume."""
        check_guide(volume, guide, self.volume_channels, self.guide_channels)
        return self.factors(guide).unsqueeze(2) * volume


def _strip(channels: int, height: int, width: int) -> nn.Conv2d:
    return nn.Conv2d(channels, channels, (height, width), padding=(height // 2, width // 2), groups=channels)
