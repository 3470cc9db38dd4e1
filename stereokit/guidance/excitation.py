"""Guided Cost volume Excitation (GCE), and its twins that add and that scale without a bound."""

from torch import Tensor, nn

from stereokit.errors import ConfigError
from stereokit.guidance.shapes import check_guide
from stereokit.layers import ConvNormAct, init_convolutions, named_activation
from stereokit.registry import GUIDANCE

__all__ = ["GCE", "AdditiveGuidance", "ScalingGuidance", "excite"]


def excite(volume: Tensor, logits: Tensor) -> Tensor:
    r"""Scales the channels of a cost volume, pixel by pixel and alike at every disparity.

    .. math:: C_o = \sigma(a) \times C_i

    Args:
        volume: (B, C, D, H, W).
        logits: a, (B, C, H, W).

    Returns:
        (B, C, D, H, W), nowhere larger in magnitude than `volume`.

    Source: CoEx, equation 1.

    >>> import torch
    >>> excite(torch.ones(1, 2, 3, 1, 1), torch.zeros(1, 2, 1, 1)).unique()
    tensor([0.5000])
    """
    return logits.sigmoid().unsqueeze(2) * volume


class _PointwiseGuidance(nn.Module):
    """Two point-wise convolutions from a guide to one value per channel of the volume."""

    def __init__(
        self, guide_channels: int, volume_channels: int, *, reduction: int = 2, activation: str = "leaky_relu"
    ) -> None:
        super().__init__()
        if reduction < 1:
            raise ConfigError(f"reduction={reduction} of the guide's channels has to be 1 or more")
        self.guide_channels = guide_channels
        self.volume_channels = volume_channels
        hidden = max(1, guide_channels // reduction)
        last = nn.Conv2d(hidden, volume_channels, 1)
        init_convolutions(last)
        self.network = nn.Sequential(
            ConvNormAct(guide_channels, hidden, 1, activation=named_activation(activation)), last
        )

    def values(self, volume: Tensor, guide: Tensor) -> Tensor:
        """One value per channel of the volume and pixel, (B, volume_channels, H, W)."""
        check_guide(volume, guide, self.volume_channels, self.guide_channels)
        return self.network(guide)


@GUIDANCE.register("gce")
class GCE(_PointwiseGuidance):
    r"""Guided Cost volume Excitation: image features choose which channels of the cost volume count.

    .. math:: \alpha = \sigma(F^{2D}(I)), \qquad C_o = \alpha \times C_i

    It drops into any volumetric network, wherever a cost volume and a feature map of one size meet.

    Args:
        guide_channels: of the image features I.
        volume_channels: of the cost volume.
        reduction: by which the width between the two convolutions is smaller than the guide's.
        activation: between them, see `named_activation`.

    Shape: volume (B, volume_channels, D, H, W) and guide (B, guide_channels, H, W) to the volume's shape.

    Raises:
        ConfigError: a reduction below 1, or an unknown activation.
        InputError: in its forward, volume and guide of other channels, or of sizes that differ.

    Source: CoEx, section "Guided Cost volume Excitation".

    >>> import torch
    >>> gce = GCE(guide_channels=96, volume_channels=8)
    >>> gce(torch.rand(2, 8, 12, 16, 32), torch.rand(2, 96, 16, 32)).shape
    torch.Size([2, 8, 12, 16, 32])
    """

    def forward(self, volume: Tensor, guide: Tensor) -> Tensor:
        """Volume and guide to the excited volume."""
        return excite(volume, self.values(volume, guide))


@GUIDANCE.register("addition")
class AdditiveGuidance(_PointwiseGuidance):
    r"""Image features added to the cost volume, alike at every disparity: :math:`C_o = C_i + F^{2D}(I)`.

    Args:
        guide_channels: of the image features I.
        volume_channels: of the cost volume.
        reduction: by which the width between the two convolutions is smaller than the guide's.
        activation: between them, see `named_activation`.

    Shape: volume (B, volume_channels, D, H, W) and guide (B, guide_channels, H, W) to the volume's shape.

    Raises:
        ConfigError: a reduction below 1, or an unknown activation.
        InputError: in its forward, volume and guide of other channels, or of sizes that differ.

    Source: CoEx, section "Ablation study", table "addition or excitation".

    >>> import torch
    >>> add = AdditiveGuidance(guide_channels=96, volume_channels=8)
    >>> add(torch.rand(1, 8, 12, 16, 32), torch.rand(1, 96, 16, 32)).shape
    torch.Size([1, 8, 12, 16, 32])
    """

    def forward(self, volume: Tensor, guide: Tensor) -> Tensor:
        """Volume and guide to their sum."""
        return volume + self.values(volume, guide).unsqueeze(2)


@GUIDANCE.register("scaling")
class ScalingGuidance(_PointwiseGuidance):
    r"""`GCE` without the sigmoid: :math:`C_o = F^{2D}(I) \times C_i`. The factor may be large, and negative.

    Args:
        guide_channels: of the image features I.
        volume_channels: of the cost volume.
        reduction: by which the width between the two convolutions is smaller than the guide's.
        activation: between them, see `named_activation`.

    Shape: volume (B, volume_channels, D, H, W) and guide (B, guide_channels, H, W) to the volume's shape.

    Raises:
        ConfigError: a reduction below 1, or an unknown activation.
        InputError: in its forward, volume and guide of other channels, or of sizes that differ.

    Source: Xu et al., "BANet: bilateral aggregation network for mobile stereo matching", ICCV 2025, its 2D form.

    >>> import torch
    >>> scale = ScalingGuidance(guide_channels=64, volume_channels=32, activation="relu6")
    >>> scale(torch.rand(1, 32, 1, 16, 32), torch.rand(1, 64, 16, 32)).shape
    torch.Size([1, 32, 1, 16, 32])
    """

    def __init__(
        self, guide_channels: int, volume_channels: int, *, reduction: int = 1, activation: str = "leaky_relu"
    ) -> None:
        super().__init__(guide_channels, volume_channels, reduction=reduction, activation=activation)

    def forward(self, volume: Tensor, guide: Tensor) -> Tensor:
        """Volume and guide to their product."""
        return volume * self.values(volume, guide).unsqueeze(2)
