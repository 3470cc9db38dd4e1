"""Neighbourhood (graph) aggregation, the alternative that CoEx compares GCE with."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.errors import ConfigError
from stereokit.guidance.shapes import check_guide
from stereokit.layers import at_least_float32, init_convolutions, leaky_relu
from stereokit.registry import GUIDANCE

__all__ = ["NeighborhoodAggregation", "neighborhood_sum"]


def neighborhood_sum(volume: Tensor, weights: Tensor) -> Tensor:
    r"""Weighted sum over the 1 x n x n neighbourhood of each voxel.

    .. math:: m_i = \sum_{j \in N(i)} e_{ji} \odot C_j

    Args:
        volume: C, (B, C, D, H, W).
        weights: e, (B, n * n, C, H, W), neighbours in row-major order from the top left. Those outside count as 0.

    Returns:
        (B, C, D, H, W).

    Source: CoEx, appendix, equation "aggmpnn".

    >>> neighborhood_sum(torch.ones(1, 1, 1, 3, 3), torch.ones(1, 9, 1, 3, 3)).squeeze()
    tensor([[4., 6., 4.],
            [6., 9., 6.],
            [4., 6., 4.]])
    """
    window = round(weights.shape[1] ** 0.5)
    height, width = volume.shape[-2:]
    padded = F.pad(volume, [window // 2] * 4)
    total = torch.zeros_like(volume)
    for j, weight in enumerate(weights.unbind(1)):
        y, x = divmod(j, window)
        total = torch.addcmul(total, padded[..., y : y + height, x : x + width], weight.unsqueeze(2))
    return total


@GUIDANCE.register("neighborhood")
class NeighborhoodAggregation(nn.Module):
    r"""Each voxel takes in its neighbours in a 1 x n x n window, by weights that the image decides.

    .. math::
        \hat e_{ji} &= \mathrm{MLP}([I_i \| I_j \| \mathrm{MLP}(p_i - p_j)]), \quad
        e_{ji} = \mathrm{softmax}_{j \in N(i)} \hat e_{ji} \\
        C_i' &= \xi(W_1 C_i + W_2 \textstyle\sum_j e_{ji} \odot C_j + b)

    The softmax runs over the neighbours inside the image, for each channel. The weights depend on the image alone and
    are shared over disparity.

    Args:
        guide_channels: of the image features I.
        volume_channels: of the cost volume.
        window: n, odd.
        position_channels: of the encoding of p_i - p_j.

    Shape: volume (B, volume_channels, D, H, W) and guide (B, guide_channels, H, W) to the volume's shape.

    Raises:
        ConfigError: the window is even.
        InputError: in its forward, volume and guide of other channels, or of sizes that differ.

    Source: CoEx, appendix "Neighborhood aggregation", equations "aggmpnn" and "edge".

    >>> block = NeighborhoodAggregation(guide_channels=96, volume_channels=8)
    >>> block(torch.rand(1, 8, 12, 16, 32), torch.rand(1, 96, 16, 32)).shape
    torch.Size([1, 8, 12, 16, 32])
    """

    offsets: Tensor

    def __init__(
        self, guide_channels: int, volume_channels: int, *, window: int = 3, position_channels: int = 8
    ) -> None:
        super().__init__()
        if window < 1 or window % 2 == 0:
            raise ConfigError(f"window={window} has no centre; use an odd one such as 3")
        self.guide_channels = guide_channels
        self.volume_channels = volume_channels
        self.window = window
        hidden = max(1, guide_channels // 2)
        self.position = nn.Sequential(
            nn.Linear(2, position_channels), leaky_relu(), nn.Linear(position_channels, position_channels)
        )
        # the first layer of the edge MLP, split by its three inputs: two maps and one vector in place of n * n maps
        self.from_centre = nn.Conv2d(guide_channels, hidden, 1)
        self.from_neighbor = nn.Conv2d(guide_channels, hidden, 1, bias=False)
        self.from_position = nn.Linear(position_channels, hidden, bias=False)
        self.edge = nn.Sequential(nn.LeakyReLU(0.01), nn.Conv2d(hidden, volume_channels, 1))
        self.keep = nn.Conv3d(volume_channels, volume_channels, 1, bias=False)
        self.take_in = nn.Conv3d(volume_channels, volume_channels, 1)
        self.activation = leaky_relu()
        init_convolutions(self)
        # p_i - p_j in units of half the window, for the neighbours j in row-major order
        steps = window // 2 - torch.arange(window)
        offsets = torch.cartesian_prod(steps, steps).reshape(-1, 2) / max(1, window // 2)
        self.register_buffer("offsets", offsets.float(), persistent=False)

    def weights(self, guide: Tensor) -> Tensor:
        """Edge weights e, (B, n * n, C, H, W): they sum to 1 over the neighbours inside the image, 0 outside."""
        height, width = guide.shape[-2:]
        padding = [self.window // 2] * 4
        centre = self.from_centre(guide)
        neighbors = F.pad(self.from_neighbor(guide), padding)
        inside = F.pad(torch.ones_like(guide[:1, :1]), padding)
        positions = self.from_position(self.position(self.offsets))
        logits = []
        for j, position in enumerate(positions):
            y, x = divmod(j, self.window)
            view = (..., slice(y, y + height), slice(x, x + width))
            edge = self.edge(centre + neighbors[view] + position[:, None, None])
            logits.append(at_least_float32(edge).masked_fill(inside[view] == 0, -torch.inf))
        return torch.stack(logits, dim=1).softmax(dim=1).to(guide.dtype)

    def forward(self, volume: Tensor, guide: Tensor) -> Tensor:
        """Volume and guide to the updated volume."""
        check_guide(volume, guide, self.volume_channels, self.guide_channels)
        message = neighborhood_sum(volume, self.weights(guide))
        return self.activation(self.keep(volume) + self.take_in(message))
