"""An aggregated volume, looked up around a disparity, at several scales."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.errors import ConfigError, InputError

__all__ = ["VolumeLookup", "look_up_volume", "volume_pyramid"]


def volume_pyramid(volume: Tensor, levels: int) -> list[Tensor]:
    """A volume (B, C, D, h, w), and its means over 2, 4, ... planes; of an odd number the last is left out.

    Raises:
        InputError: fewer planes than the levels halve.

    >>> [tuple(level.shape) for level in volume_pyramid(torch.rand(1, 2, 5, 3, 4), 2)]
    [(1, 2, 5, 3, 4), (1, 2, 2, 3, 4)]
    """
    if levels < 1 or volume.shape[2] >> (levels - 1) < 1:
        raise InputError(
            f"a pyramid of {levels} levels wants at least {2 ** max(levels - 1, 0)} planes; got {volume.shape[2]}"
        )
    pyramid = [volume]
    for _ in range(levels - 1):
        pyramid.append(F.avg_pool3d(pyramid[-1], (2, 1, 1)))
    return pyramid


def look_up_volume(pyramid: Sequence[Tensor], disparity: Tensor, radius: int) -> Tensor:
    r"""The channels of a volume around a disparity, at each level of a pyramid.

    .. math:: f_{i,c,k}(y, x) = G_i\Big(c, \frac{d(y, x)}{2^i} + k, y, x\Big), \quad k = -r \ldots r

    Between two planes it is interpolated linearly; outside it is 0.

    Args:
        pyramid: of `volume_pyramid`.
        disparity: d, (B, h, w), in planes of the first level.
        radius: r.

    Returns:
        (B, levels * C * (2 r + 1), h, w), level by level, then channel by channel.

    Source: Xu et al., "Iterative geometry encoding volume for stereo matching", CVPR 2023, section 3.3.

    >>> volume = torch.arange(5.0).reshape(1, 1, 5, 1, 1)
    >>> look_up_volume([volume], torch.full((1, 1, 1), 3.5), 1).flatten()
    tensor([2.5000, 3.5000, 2.0000])
    """
    found = []
    for level, volume in enumerate(pyramid):
        place = disparity / 2**level
        whole = place.floor()
        steps = torch.arange(-radius, radius + 2, device=disparity.device).reshape(-1, 1, 1)
        planes = whole.long().unsqueeze(1) + steps
        inside = ((planes >= 0) & (planes < volume.shape[2])).unsqueeze(1)
        index = planes.clamp(0, volume.shape[2] - 1).unsqueeze(1).expand(-1, volume.shape[1], -1, -1, -1)
        values = torch.where(inside, volume.gather(2, index), 0.0)
        share = (place - whole).unsqueeze(1).unsqueeze(1)
        found.append((values[:, :, :-1] * (1 - share) + values[:, :, 1:] * share).flatten(1, 2))
    return torch.cat(found, dim=1)


class VolumeLookup(nn.Module):
    """`look_up_volume` as a module.

    Args:
        channels: of the volume.
        levels: of the pyramid.
        radius: in planes of each level.

    Shape: a pyramid (of `volume_pyramid`) and a disparity (B, h, w), in planes, to (B, out_channels, h, w).

    Raises:
        ConfigError: no level, or a negative radius.

    Source: Xu et al., "Iterative geometry encoding volume for stereo matching", CVPR 2023, section 3.3.

    >>> lookup = VolumeLookup(channels=8)
    >>> lookup(volume_pyramid(torch.rand(1, 8, 12, 4, 6), 2), torch.rand(1, 4, 6)).shape[1] == lookup.out_channels
    True
    """

    def __init__(self, *, channels: int, levels: int = 2, radius: int = 4) -> None:
        super().__init__()
        if levels < 1 or radius < 0:
            raise ConfigError(f"levels={levels} and radius={radius} of a lookup: use at least 1 level and 0 planes")
        self.levels = levels
        self.radius = radius
        self.out_channels = levels * channels * (2 * radius + 1)

    def forward(self, pyramid: Sequence[Tensor], disparity: Tensor) -> Tensor:
        """The channels around a disparity."""
        return look_up_volume(pyramid, disparity, self.radius)

    def extra_repr(self) -> str:
        """Levels and radius, for printing."""
        return f"levels={self.levels}, radius={self.radius}"
