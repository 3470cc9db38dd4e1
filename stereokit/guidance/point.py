"""Where an aggregation lets image features in."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args

from torch import Tensor, nn

from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.errors import ConfigError
from stereokit.registry import GUIDANCE

__all__ = ["GuidancePlan", "GuidancePoint", "NoGuidance"]


@GUIDANCE.register("none")
class NoGuidance(nn.Module):
    """Leaves the volume as it is.

    >>> import torch
    >>> NoGuidance()(torch.ones(1, 1, 1, 1, 2), torch.rand(1, 4, 1, 2)).sum()
    tensor(2.)
    """

    def __init__(self, guide_channels: int | None = None, volume_channels: int | None = None) -> None:
        super().__init__()

    def forward(self, volume: Tensor, guide: Tensor | None = None) -> Tensor:
        """The volume."""
        return volume


class GuidancePoint(nn.Module):
    """Guidance at one place of an aggregation; without guidance, the volume passes through.

    Args:
        guidance: makes the block; None for none.
        stride: of the volume at this place.
        guide_channels: of the guides at hand, by stride.
        volume_channels: of the volume at this place.

    Raises:
        ConfigError: there is no guide at this stride.

    >>> import torch
    >>> from stereokit.guidance import GCE
    >>> point = GuidancePoint(GCE, stride=8, guide_channels={4: 96, 8: 64}, volume_channels=16)
    >>> point(torch.rand(1, 16, 3, 4, 5), {8: torch.rand(1, 64, 4, 5)}).shape
    torch.Size([1, 16, 3, 4, 5])
    """

    def __init__(
        self,
        guidance: GuidanceFactory | None,
        *,
        stride: int,
        guide_channels: Mapping[int, int],
        volume_channels: int,
    ) -> None:
        super().__init__()
        self.stride = stride
        self.guide_channels: dict[int, int] = {}
        if guidance is None:
            self.block: nn.Module = NoGuidance()
            return
        if stride not in guide_channels:
            raise ConfigError(
                f"guidance at stride {stride} wants a guide of that stride; there are guides at "
                f"{', '.join(map(str, guide_channels)) or 'none'}"
            )
        self.guide_channels[stride] = guide_channels[stride]
        self.block = guidance(guide_channels=guide_channels[stride], volume_channels=volume_channels)

    def forward(self, volume: Tensor, guides: Guides) -> Tensor:
        """The volume, guided by the map of its stride."""
        return self.block(volume, guides[self.stride]) if self.guide_channels else volume

    def on_maps(self, maps: Tensor, guides: Guides) -> Tensor:
        """Maps (B, C, H, W) in place of a volume: guided as one of depth 1."""
        return self(maps.unsqueeze(2), guides).squeeze(2) if self.guide_channels else maps


@dataclass(frozen=True)
class GuidancePlan:
    """Makes the guidance points of one aggregation.

    Args:
        guidance: makes a guidance block; None for none.
        placement: "one" guides the first point only, "full" every point.
        stride: of the cost volume that enters the aggregation.
        guide_channels: of the guides at hand, by stride.

    Raises:
        ConfigError: another placement.

    >>> from stereokit.guidance import GCE
    >>> plan = GuidancePlan(GCE, "one", stride=4, guide_channels={4: 96})
    >>> plan.first(8).guide_channels, plan.at(2, 16).guide_channels
    ({4: 96}, {})
    """

    guidance: GuidanceFactory | None
    placement: GuidancePlacement
    stride: int
    guide_channels: Mapping[int, int] | None

    def __post_init__(self) -> None:
        if self.placement not in get_args(GuidancePlacement):
            raise ConfigError(
                f"guidance_at={self.placement!r} is not a placement; use 'one' or 'full', or guidance='none'"
            )

    def first(self, volume_channels: int) -> GuidancePoint:
        """The point at the finest scale, where all that follows feels it."""
        return self._point(self.guidance, 1, volume_channels)

    def at(self, scale: int, volume_channels: int) -> GuidancePoint:
        """A further point, where the volume is `scale` times coarser than at the entrance."""
        return self._point(self.guidance if self.placement == "full" else None, scale, volume_channels)

    def _point(self, guidance: GuidanceFactory | None, scale: int, volume_channels: int) -> GuidancePoint:
        return GuidancePoint(
            guidance,
            stride=self.stride * scale,
            guide_channels=self.guide_channels or {},
            volume_channels=volume_channels,
        )

    @staticmethod
    def guides_read_by(aggregation: nn.Module) -> dict[int, int]:
        """The guides that the points inside an aggregation read: channels by stride."""
        points = [m for m in aggregation.modules() if isinstance(m, GuidancePoint)]
        return {stride: channels for point in points for stride, channels in point.guide_channels.items()}
