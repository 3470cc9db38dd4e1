"""An aggregation around another one."""

from collections.abc import Callable, Mapping
from typing import Any

from torch import nn

from stereokit.contracts import Aggregation, GuidanceFactory, GuidancePlacement, Guides, Head
from stereokit.errors import ConfigError
from stereokit.registry import AGGREGATIONS

__all__ = ["Wrapper"]


class Wrapper(nn.Module):
    """What adds something to every head of another aggregation, its `base`; in all else it is like that one.

    Args:
        base: an aggregation, by name or as ``{"name": ..., **arguments}``.
        in_channels: of the cost volume.
        planes: likewise.
        stride: likewise.
        guide_channels: of the guides, by stride.
        guidance: makes a guidance block, such as `GCE`; None for none.
        guidance_at: "one" or "full"; None for the usual one of the base.

    Raises:
        ConfigError: a base that can't be built.
    """

    def __init__(
        self,
        *,
        base: str | Mapping[str, Any],
        in_channels: int,
        planes: int,
        stride: int = 4,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement | None = None,
    ) -> None:
        super().__init__()
        self.base_name, arguments = AGGREGATIONS.named(base, "the base of an aggregation is the name of another one")
        offered: dict[str, Any] = {
            "in_channels": in_channels,
            "planes": planes,
            "stride": stride,
            "guide_channels": guide_channels,
            "guidance": guidance,
        }
        if guidance_at is not None:
            offered["guidance_at"] = guidance_at
        self.base: Aggregation = AGGREGATIONS.build(self.base_name, arguments, offered)
        self.in_channels = in_channels
        self.guide_channels = self.base.guide_channels
        self.multiple, self.planes_multiple = self.base.multiple, self.base.planes_multiple
        self.loss_weights = self.base.loss_weights
        self.upscale = self.base.upscale
        self.planes_upscale = int(getattr(self.base, "planes_upscale", self.base.upscale))
        self.scales = int(getattr(self.base, "scales", 1))
        self.least_size = int(getattr(self.base, "least_size", 0))

    def heads_with(self, blocks: nn.ModuleList, volume: Any, guides: Guides) -> list[tuple[Head, nn.Module]]:
        """What the base says, each head with its own block; in eval mode there may be the last one alone."""
        heads = [head if isinstance(head, Head) else Head(head) for head in self.base(volume, guides)]
        return list(zip(heads, list(blocks)[-len(heads) :], strict=True))

    def replace_heads(self, name: str, make: Callable[[nn.Module], nn.Module]) -> None:
        """Puts something in the place of each module that turns a volume into logits.

        Args:
            name: of this aggregation, for the message.
            make: what takes its place.

        Raises:
            ConfigError: the base has none.
        """
        places: tuple[str, ...] = getattr(self.base, "volume_heads", ())
        if not places:
            raise ConfigError(
                f"aggregation {name!r} wants a base whose heads are 3D convolutions, but {self.base_name!r} has none; "
                "use another base, such as 'stacked_hourglass'"
            )
        for place in places:
            head = getattr(self.base, place)
            setattr(self.base, place, nn.ModuleList(map(make, head)) if isinstance(head, nn.ModuleList) else make(head))
