"""The cost aggregation of LEAStereo: searched cells of 3D convolutions at three scales, and two long skips."""

from collections.abc import Mapping, Sequence

from torch import Tensor, nn

from stereokit.contracts import GuidanceFactory, GuidancePlacement, Guides
from stereokit.guidance.point import GuidancePlan
from stereokit.layers import CellNodes, ConvNormAct, LevelPath, init_convolutions, level_size, relu, resize
from stereokit.registry import AGGREGATIONS

__all__ = ["LevelPathAggregation"]

NODES: CellNodes = (
    (("s0", "conv"), ("s1", "conv")),
    (("s1", "conv"), ("n0", "conv")),
    (("s1", "conv"), ("n1", "conv")),
)
"""That the search for aggregation found."""


@AGGREGATIONS.register("level_path")
class LevelPathAggregation(nn.Module):
    """Two convolutions, a path of searched cells, and back to the volume's own scale.

    Guidance at "one" place acts behind the first convolution; "full" adds a place behind each cell.

    Args:
        in_channels: of the cost volume.
        stride: of the cost volume.
        guide_channels: of the guides, by stride; needed at `stride` for "one", at those of all levels for "full".
        guidance: makes a guidance block, such as `GCE`; None for none.
        guidance_at: "one" or "full".
        levels: of the cells: 0 is the scale of the volume, each level halves it.
        nodes: of every cell, see `SearchedCell`.
        skips: long skips between cells, see `LevelPath`.
        filters: width of a cell's nodes at level 0.

    Shape: volume (B, in_channels, D, H, W) and guides by stride to one tensor (B, D, H, W) of logits, larger is better.
    D, H and W may be odd.

    Raises:
        ConfigError: levels, nodes or skips that make no path.

    Source: Cheng et al., "Hierarchical neural architecture search for deep stereo matching", NeurIPS 2020, figure 5.

    >>> import torch
    >>> aggregation = LevelPathAggregation(in_channels=4, filters=2)
    >>> aggregation.eval()(torch.rand(1, 4, 16, 8, 16), {})[-1].shape
    torch.Size([1, 16, 8, 16])
    """

    multiple = 8
    planes_multiple = 1
    upscale = 1
    loss_weights = (1.0,)
    volume_heads = ("head",)

    def __init__(
        self,
        *,
        in_channels: int,
        stride: int = 3,
        guide_channels: Mapping[int, int] | None = None,
        guidance: GuidanceFactory | None = None,
        guidance_at: GuidancePlacement = "one",
        levels: Sequence[int] = (1, 1, 2, 2, 1, 2, 2, 2, 1, 1, 0, 1),
        nodes: CellNodes = NODES,
        skips: Sequence[Sequence[int]] = ((1, 4), (4, 8)),
        filters: int = 8,
    ) -> None:
        super().__init__()
        self.in_channels = in_channels
        channels = 4 * filters
        self.stem0 = ConvNormAct(in_channels, channels, dims=3, activation=relu)
        plan = GuidancePlan(guidance, guidance_at, stride, guide_channels)
        self.guidance = plan.first(channels)
        self.stem1 = ConvNormAct(channels, channels, dims=3, activation=relu)
        self.path = LevelPath(levels, nodes, dims=3, channels=(channels, channels), filters=filters, skips=skips)
        self.points = nn.ModuleList(plan.at(2**level, c) for level, c in zip(levels, self.path.widths, strict=True))
        self.ladder = nn.ModuleList(
            ConvNormAct(channels * 2**level, channels * 2 ** (level - 1), 1, dims=3, activation=relu)
            for level in range(levels[-1], 0, -1)
        )
        self.head = nn.Conv3d(channels, 1, 3, padding=1, bias=False)
        init_convolutions(self.head)
        self.guide_channels = GuidancePlan.guides_read_by(self)

    def forward(self, volume: Tensor, guides: Guides) -> tuple[Tensor, ...]:
        """Volume and guides to logits."""
        before = self.guidance(self.stem0(volume), guides)
        last = self.stem1(before)
        x = self.path(before, last, lambda number, output: self.points[number](output, guides))
        for step, conv in enumerate(self.ladder, start=1):
            x = resize(conv(x), level_size(last.shape[2:], len(self.ladder) - step))
        return (self.head(x).squeeze(1),)
