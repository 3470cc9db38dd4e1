"""Correlation cost volumes: cosine similarity, whole or by groups of channels."""

from einops import rearrange
from torch import Tensor, nn
from torch.nn import functional as F

from stereokit.costs.projection import Projected, Projection
from stereokit.costs.shift import Planes, check_features, inner_products, seen_from_left
from stereokit.errors import ConfigError, InputError
from stereokit.layers import at_least_float32
from stereokit.registry import COSTS

__all__ = [
    "CorrelationVolume",
    "GroupwiseCorrelationVolume",
    "correlation_volume",
    "groupwise_correlation_volume",
]

EPS = 1e-4


def correlation_volume(left: Tensor, right: Tensor, planes: Planes) -> Tensor:
    r"""Cosine similarity of left and shifted right features.

    .. math:: C(d, y, x) = \frac{l(y, x) \cdot r(y, x - d)}{\|l(y, x)\|\,\|r(y, x - d)\|}, \quad 0 \text{ where } x < d

    Args:
        left: (B, C, H, W).
        right: (B, C, H, W).
        planes: D, for the disparities 0 ... D - 1, or candidates (B, D, H, W); in pixels of the maps.

    Returns:
        (B, 1, D, H, W), in [-1, 1]. All-zero features give 0.

    Raises:
        InputError: the maps are not a pair.

    Source: CoEx, section "Matching cost computation".

    >>> import torch
    >>> features = torch.rand(1, 8, 4, 16)
    >>> correlation_volume(features, features.roll(-3, -1), 6)[0, 0, :, 0, 10].argmax()
    tensor(3)
    """
    check_features(left, right, planes)
    if isinstance(planes, Tensor):
        shifted, seen = seen_from_left(right, planes)
        return (_normalise(left).unsqueeze(2) * _normalise(shifted) * seen).sum(1, keepdim=True)
    return inner_products(_normalise(left), _normalise(right), planes).unsqueeze(1)


def groupwise_correlation_volume(
    left: Tensor, right: Tensor, planes: Planes, groups: int, *, normalise: bool = False
) -> Tensor:
    r"""Mean product of left and shifted right features, by groups of channels.

    .. math:: C(g, d, y, x) = \frac{1}{|g|} \sum_{c \in g} l_c(y, x)\, r_c(y, x - d), \quad 0 \text{ where } x < d

    Args:
        left: (B, C, H, W).
        right: (B, C, H, W).
        planes: D, for the disparities 0 ... D - 1, or candidates (B, D, H, W); in pixels of the maps.
        groups: G, which divides C.
        normalise: cosine similarity per group in place of the mean product.

    Returns:
        (B, G, D, H, W).

    Raises:
        InputError: the maps are not a pair, or the groups do not divide their channels.

    Source: Guo et al., "Group-wise correlation stereo network", CVPR 2019, equation 2.

    >>> import torch
    >>> groupwise_correlation_volume(torch.rand(1, 8, 4, 16), torch.rand(1, 8, 4, 16), 6, groups=4).shape
    torch.Size([1, 4, 6, 4, 16])
    """
    check_features(left, right, planes)
    batch, channels = left.shape[:2]
    if groups < 1 or channels % groups:
        raise InputError(f"{groups} groups do not divide {channels} channels")
    if isinstance(planes, Tensor):
        shifted, seen = seen_from_left(right, planes)
        by_group, others = (rearrange(x, "b (g c) ... -> b g c ...", g=groups) for x in (left.unsqueeze(2), shifted))
        if normalise:
            return (_normalise(by_group, dim=2) * _normalise(others, dim=2)).sum(2) * seen
        return (by_group / (channels // groups) * others).sum(2) * seen
    left, right = (rearrange(x, "b (g c) h w -> (b g) c h w", g=groups) for x in (left, right))
    if normalise:
        volume = inner_products(_normalise(left), _normalise(right), planes)
    else:
        # divided first: sums of products overflow in half precision
        volume = inner_products(left / (channels // groups), right, planes)
    return rearrange(volume, "(b g) d h w -> b g d h w", b=batch)


def _normalise(x: Tensor, dim: int = 1) -> Tensor:
    # the eps keeps all-zero features finite
    return F.normalize(at_least_float32(x), dim=dim, eps=EPS).to(x.dtype)


@COSTS.register("correlation")
class CorrelationVolume(nn.Module):
    """`correlation_volume` of projected features.

    Args:
        in_channels: of the features.
        planes: of disparity.
        projection: widths of the two convolutions before the comparison, None for none.

    Shape: two (B, in_channels, H, W) to (B, 1, planes, H, W).

    Source: CoEx, section "Matching cost computation".

    >>> import torch
    >>> cost = CorrelationVolume(in_channels=96, planes=48, projection=(48, 48))
    >>> cost(torch.rand(1, 96, 8, 64), torch.rand(1, 96, 8, 64)).shape
    torch.Size([1, 1, 48, 8, 64])
    """

    out_channels = 1
    warps = True

    def __init__(self, *, in_channels: int, planes: int, projection: Projected = None) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.planes = planes
        self.projection = Projection(in_channels, projection)

    def forward(self, left: Tensor, right: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Left and right features to a cost volume."""
        left, right = self.projection(left, right)
        return correlation_volume(left, right, self.planes if candidates is None else candidates)


@COSTS.register("groupwise_correlation")
class GroupwiseCorrelationVolume(nn.Module):
    """`groupwise_correlation_volume` of projected features; of one group it is the mean product of all channels.

    Args:
        in_channels: of the features.
        planes: of disparity.
        groups: divides the channels that are compared; 8 where neither it nor `group_channels` is given.
        group_channels: how many channels make a group, in place of a number of groups: what fits features of any width.
        normalise: cosine similarity per group in place of the mean product.
        projection: widths of the two convolutions before the comparison, None for none.

    Shape: two (B, in_channels, H, W) to (B, groups, planes, H, W).

    Raises:
        ConfigError: the groups do not divide the channels, or both of their arguments are given.

    Source: Guo et al., "Group-wise correlation stereo network", CVPR 2019.

    >>> GroupwiseCorrelationVolume(in_channels=96, planes=48, groups=12).out_channels
    12
    >>> GroupwiseCorrelationVolume(in_channels=96, planes=48, group_channels=12).out_channels
    8
    """

    warps = True

    def __init__(
        self,
        *,
        in_channels: int,
        planes: int,
        groups: int | None = None,
        group_channels: int | None = None,
        normalise: bool = False,
        projection: Projected = None,
    ) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.planes = planes
        self.normalise = normalise
        self.projection = Projection(in_channels, projection)
        self.groups = self.out_channels = _groups(self.projection.out_channels, groups, group_channels)

    def forward(self, left: Tensor, right: Tensor, candidates: Tensor | None = None) -> Tensor:
        """Left and right features to a cost volume."""
        left, right = self.projection(left, right)
        planes = self.planes if candidates is None else candidates
        return groupwise_correlation_volume(left, right, planes, self.groups, normalise=self.normalise)


def _groups(channels: int, groups: int | None, group_channels: int | None) -> int:
    """The number of groups."""
    if groups is not None and group_channels is not None:
        raise ConfigError(f"give one of groups={groups} and group_channels={group_channels}, and None for the other")
    name, given = ("groups", groups) if group_channels is None else ("group_channels", group_channels)
    number = 8 if given is None else given
    if number < 1 or channels % number:
        fitting = [n for n in range(1, channels + 1) if channels % n == 0]
        raise ConfigError(f"{name}={number} does not divide the {channels} channels compared; use {fitting}")
    return number if group_channels is None else channels // number
